"""A sealed demonstration: an effect is concealed in simulated runs, diagnosed without the answer, and revealed."""
