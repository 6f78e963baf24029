"""Who is asking: password, session, token, and what each role may."""
