"""Training of the shipped key point network; the product never imports it."""
