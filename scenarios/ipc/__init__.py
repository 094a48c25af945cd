"""Processes of this machine: starting, watching, messages and shared memory."""
