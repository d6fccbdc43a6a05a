"""Constants, tables and memory of the friction mixture, and functions of them alone."""
