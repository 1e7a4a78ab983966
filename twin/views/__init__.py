"""What a twin shows: heat flows, modes in words, the network's overview and places."""
