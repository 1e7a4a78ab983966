"""Where and when: a free smooth series at every place, given what was found at others."""
