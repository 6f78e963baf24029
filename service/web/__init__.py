"""The status page and its JSON. It shows; it starts nothing, moves nothing and changes nothing."""
