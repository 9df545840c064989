"""Recordings of other platforms than the road vehicle: people, robots and drones, in and around buildings."""
