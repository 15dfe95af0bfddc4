"""Fitting: poses fitted to observations with exact bone lengths."""
