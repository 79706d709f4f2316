"""The processes of a bench, a robot and a replay; launch files read them."""
