"""What any contact needs: everything that can touch, which pairs are near, how far they are, and how far they may go."""
