"""What a score is compared with: floors, and LPIPS with weights of the user's own."""
