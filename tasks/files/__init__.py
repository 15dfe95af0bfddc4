"""Files of users: opened, downloaded, and choices written in them."""
