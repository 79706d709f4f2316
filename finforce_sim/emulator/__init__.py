"""An emulated SSG-48 behind an emulated SLCAN adapter, in real or in stepped time."""
