"""Pictures and recordings of what a run did."""
