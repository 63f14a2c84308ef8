"""What `fairway db` does; the commands stand in rtdb/cli.py (those that look) and in change.py (those that change)."""
