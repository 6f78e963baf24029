"""NC programs for controllers that Abbe does not move: the operator starts them while Abbe listens."""
