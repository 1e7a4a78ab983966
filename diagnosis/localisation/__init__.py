"""Where and when: a free smooth series at every place, beside what was found at others."""
