"""What `fairway new` writes: a module of each kind, and its test."""
