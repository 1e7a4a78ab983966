"""What no mechanism lists: its terms as candidates, and the search among them once all that is listed was tried."""
