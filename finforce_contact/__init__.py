"""The object: its mesh, its pose and the place where it touches a jaw."""
