"""Types of machine to be drawn from, next to the sample machine: horizontal and vertical centre, lathe and its axes."""
