"""The status page, its JSON and the way in. It shows; it moves nothing, and what changes something is guarded and recorded."""
