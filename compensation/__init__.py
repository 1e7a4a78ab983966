"""Compensation at the machine: a promoted model beside the control, safely, and its exports to controls."""
