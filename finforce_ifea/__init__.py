"""The jaw and its mechanics: geometry, mesh, elements, frame, inverse problem."""
