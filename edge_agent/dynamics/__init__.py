"""Vehicle and tyre equations as compiled scalar functions; they know no filter, no file and no clock."""
