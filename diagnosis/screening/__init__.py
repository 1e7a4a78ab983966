"""How well each candidate predicts batches left out, all of them from one linearisation."""
