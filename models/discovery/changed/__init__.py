"""What has changed since another campaign."""
