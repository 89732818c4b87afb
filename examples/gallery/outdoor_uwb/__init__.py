"""Somebody walks outdoors with a tag; anchors that stand close together measure distances to it."""
