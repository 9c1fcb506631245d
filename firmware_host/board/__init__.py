"""What a host does with boards: sessions, banks, programming, fleets."""
