"""From many scored cells to one model: the crossing, the race, promotion, trust in it, and its correction later."""
