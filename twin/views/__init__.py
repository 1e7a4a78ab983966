"""Views of a twin: heat flows, modes, the network's overview and its layout."""
