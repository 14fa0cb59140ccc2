"""What all pictures share: colours, letters, panels, frames and spectra."""
