"""The work of one command: training, diagnosis, replay, compensation, and what each is given."""
