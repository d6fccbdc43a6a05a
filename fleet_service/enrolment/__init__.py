"""Enrolment: the list of names, their certificates, and their rights at the routers."""
