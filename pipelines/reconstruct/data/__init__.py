"""What photographs offer to a reconstruction: depths, silhouettes, visibility."""
