"""Which measurements to make in the time there is, and what each of them buys."""
