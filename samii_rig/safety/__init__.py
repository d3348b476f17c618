"""The door to the actuator: what is known, what is allowed, and the one gate that judges both."""
