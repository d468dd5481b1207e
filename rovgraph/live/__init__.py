"""The online mode: sources in, navigation solutions out, nothing that stops because a sensor does."""
