"""Commands about compensation tables: propose, approve, push, roll back."""
