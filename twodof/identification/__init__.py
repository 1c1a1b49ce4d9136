"""Identification: physical parameters of a robot from bags of its motion."""
