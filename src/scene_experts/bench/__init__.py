"""What this machine makes of the package: times, each beside a named peer, in about a minute (`scene-experts bench`)."""
