"""Heads become whole here: sides, hair and the mouth interior, where training pictures show too little of them."""
