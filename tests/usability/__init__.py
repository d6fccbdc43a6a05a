"""How it is to use: what a person meets in the first hour, as figures. `make usability`."""
