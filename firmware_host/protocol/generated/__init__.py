"""What `firmware_host.protocol.generate` writes from `protocol.toml` and the codebook."""
