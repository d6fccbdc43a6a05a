"""Cost of each part on this machine; `make bench`."""
