"""Enrolment: the list of permitted names, their certificates, and their access rights at the
routers.
"""
