"""Plan which measurements to make in the available time, with the uncertainty that each of them reaches."""
