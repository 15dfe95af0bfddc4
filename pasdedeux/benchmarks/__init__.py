"""Throughput of each stage here against its plain form, and the made-up inputs that this is measured on."""
