"""Where and when: a free smooth series at every place, and what an unlisted effect follows."""
