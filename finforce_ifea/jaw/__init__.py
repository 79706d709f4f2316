"""The jaw: its file, drawing, mesh, material and calibration."""
