"""The key of a case with a concealed effect, and which findings it calls true."""
