"""Plant A: castings as finite elements in space, their displacement by thermoelasticity."""
