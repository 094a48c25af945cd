"""`nav`: classical navigation by a lidar: costmap, local plan, regulated pure pursuit."""
