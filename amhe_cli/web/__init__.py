"""What all pages share: their frame, their style, and figures of curves with the script that draws them."""
