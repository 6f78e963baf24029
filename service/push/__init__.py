"""Push of a compensation table into a controller, and rollback: a pure state machine, its journal, and the adapter to a controller."""
