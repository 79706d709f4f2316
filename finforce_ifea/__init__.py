"""The jaw and its mechanics: geometry, mesh, elements, frame, inverse problem."""

from finforce.caches import keep_compiled

keep_compiled()
