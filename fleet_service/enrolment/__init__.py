"""Who takes part: the list of names, their certificates, and what each may do at the routers."""
