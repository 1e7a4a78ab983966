"""Answers scored against the key: outcomes by case and term, the goals, the true model, tables that a report shows."""
