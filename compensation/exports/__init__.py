"""A promoted model in the form that another program or a control takes."""
