"""Commands about compensation tables: propose, approve, push, take back."""
