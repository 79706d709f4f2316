"""Which processes make up a bench, a robot and a replay; launch files read them."""
