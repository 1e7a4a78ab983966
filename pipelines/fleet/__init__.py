"""Many machines: the fleet file, its schedule, the state of every machine and its alerts."""
