"""Two textbook reactors on which an extended Kalman filter settles at negative pressures."""
