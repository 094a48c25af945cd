"""Which side people drive on, by coordinates: OSM files do not say."""

from __future__ import annotations

_Box = tuple[float, float, float, float]

LEFT_HAND: dict[str, tuple[_Box, ...]] = {
    "United Kingdom and Ireland": (
        (-10.8, 49.85, -1.0, 61.0),
        (-1.1, 50.6, 0.9, 61.0),
        (0.8, 50.88, 1.5, 51.5),
        (0.8, 51.3, 1.8, 53.0),
    ),
    "Channel Islands": ((-2.75, 49.1, -1.98, 49.8),),
    "Malta": ((14.1, 35.7, 14.7, 36.1),),
    "Cyprus": ((32.2, 34.5, 34.7, 35.75),),
    "India": (
        (68.6, 20.0, 88.1, 26.3),
        (72.5, 6.7, 88.0, 20.1),
        (73.8, 26.2, 80.2, 34.6),
        (88.0, 21.5, 89.0, 28.2),
        (89.0, 25.1, 94.3, 27.8),
        (91.1, 22.9, 93.3, 25.2),
    ),
    "Pakistan": ((61.7, 24.7, 70.0, 29.6), (66.5, 24.7, 74.4, 32.3), (70.4, 32.2, 76.0, 36.8)),
    "Sri Lanka": ((79.5, 5.8, 82.0, 10.0),),
    "Maldives": ((72.5, -0.8, 73.9, 7.2),),
    "Bangladesh": ((88.0, 21.9, 92.3, 26.7),),
    "Nepal": ((80.0, 26.3, 88.2, 29.0),),
    "Bhutan": ((88.7, 26.6, 92.2, 28.0),),
    "Thailand": (
        (98.6, 12.5, 102.3, 17.7),
        (98.2, 5.7, 100.3, 12.6),
        (97.6, 17.0, 100.5, 20.3),
        (100.2, 5.7, 102.0, 7.5),
        (102.0, 14.5, 104.6, 17.7),
    ),
    "Malaysia, Singapore, Brunei": ((99.6, 1.15, 104.5, 6.5), (109.4, 0.8, 119.4, 7.4)),
    "Indonesia and Timor": (
        (94.9, -11.1, 141.0, 0.8),
        (94.9, 0.7, 99.5, 6.1),
        (114.9, 0.7, 118.0, 4.2),
    ),
    "Papua New Guinea": ((141.0, -11.8, 156.2, -0.8),),
    "Hong Kong": ((113.82, 22.13, 114.45, 22.53),),
    "Macao": ((113.52, 22.1, 113.62, 22.217),),
    "Japan": (
        (128.0, 30.0, 132.2, 34.8),
        (131.5, 30.0, 146.1, 41.6),
        (139.3, 41.2, 146.0, 45.6),
        (122.8, 23.9, 131.4, 30.1),
    ),
    "Australia": ((112.8, -44.0, 154.0, -9.8),),
    "New Zealand": ((166.0, -47.6, 179.0, -34.0),),
    "Fiji": ((176.8, -19.3, 180.0, -15.7),),
    "South Africa, Lesotho, Eswatini": (
        (16.3, -35.0, 31.0, -25.9),
        (27.0, -25.9, 32.15, -22.1),
        (30.9, -31.0, 32.95, -26.8),
    ),
    "Namibia": ((12.4, -28.7, 20.0, -17.45),),
    "Botswana": ((20.0, -26.9, 29.3, -17.8),),
    "Zimbabwe": ((25.3, -22.4, 33.0, -15.6),),
    "Zambia": ((22.0, -18.0, 30.5, -13.3), (28.5, -15.5, 33.6, -8.3)),
    "Malawi": ((32.7, -17.1, 35.9, -9.4),),
    "Mozambique": ((31.9, -26.8, 41.0, -10.5),),
    "Tanzania": ((30.9, -11.7, 40.5, -4.0), (30.6, -4.3, 36.0, -1.0)),
    "Kenya": ((34.0, -4.6, 41.8, 4.3),),
    "Uganda": ((30.0, -1.4, 34.9, 3.5),),
    "Mauritius": ((57.2, -20.6, 57.9, -19.9),),
    "Seychelles": ((55.1, -4.9, 56.0, -4.2),),
    "Jamaica": ((-78.5, 17.6, -76.1, 18.6),),
    "Bahamas": ((-79.4, 20.8, -72.6, 27.4),),
    "Cayman Islands": ((-81.5, 19.2, -79.7, 19.8),),
    "Bermuda": ((-65.0, 32.2, -64.6, 32.5),),
    "Virgin Islands": ((-65.1, 17.6, -64.2, 18.8),),
    "Anguilla": ((-63.2, 18.15, -62.9, 18.3),),
    "Lesser Antilles": (
        (-62.95, 16.9, -61.6, 17.8),
        (-61.55, 15.15, -61.2, 15.7),
        (-61.9, 11.9, -59.3, 14.15),
    ),
    "Trinidad and Tobago": ((-61.95, 10.0, -60.4, 11.4),),
    "Guyana": ((-60.0, 1.2, -57.2, 8.6),),
    "Suriname": ((-57.2, 1.8, -54.2, 6.1),),
}
"""Boxes (west, south, east, north), degrees, of the countries that drive on the left. Rough near
land borders."""


def left_hand_country(lon: float, lat: float) -> str | None:
    """The country whose box a point lies in, if people drive on the left there; None elsewhere."""
    for country, boxes in LEFT_HAND.items():
        if any(west <= lon <= east and south <= lat <= north for west, south, east, north in boxes):
            return country
    return None
