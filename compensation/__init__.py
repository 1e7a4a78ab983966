"""Compensation at the machine: a promoted model next to the control, safely, and its exports to controls."""
