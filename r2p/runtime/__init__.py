"""What nodes publish and subscribe with, under the transports."""
