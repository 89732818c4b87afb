"""Systems from models written for other packages, one function per package."""
