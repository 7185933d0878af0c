"""What each stage of the cycle costs."""
