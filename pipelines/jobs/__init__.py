"""The work of one command: training, diagnosis, compensation, and what each is given."""
