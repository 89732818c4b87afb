"""A walker's tag is ranged by anchors outdoors, with few ranges grossly wrong; sight may be blocked."""
