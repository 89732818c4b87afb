"""Systems from models that are written for other packages, one function for each package."""
