"""The way of a compensation table into a controller, and back: a pure state machine, its journal, and the adapter that acts for it."""
