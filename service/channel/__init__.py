"""The narrow way between the two processes of the service: messages with types, and how they travel."""
