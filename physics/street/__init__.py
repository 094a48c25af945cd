"""Buildings, street furniture, vehicles and ground covers of a street map."""
