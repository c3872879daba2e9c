"""Studies that answer one question with data that is not part of the product. Nothing imports them but their tests."""
