"""The object: its mesh, its pose and the place where it touches a jaw."""

from finforce.caches import keep_compiled

keep_compiled()
