"""One filter for the contact of one jaw: process, measurement, update and read-out."""
