"""NC programs for controllers that nobody moves by registers: what the operator starts while Abbe only listens."""
