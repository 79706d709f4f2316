"""What happens in a synthetic recording: scenarios, scripts, objects."""
