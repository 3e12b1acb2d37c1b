"""What a field is: a module from points to signed distances, closed forms, and their algebra."""
