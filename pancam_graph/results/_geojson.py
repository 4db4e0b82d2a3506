"""Layers as GeoJSON (RFC 7946, with the `crs` of its draft of 2008, which GIS programs read)."""

import json

from pancam_graph.data import Site
from pancam_graph.results._gis_layers import Feature, Layer

__all__ = ["geojson"]


def geojson(layer: Layer, site: Site) -> bytes:
    """A layer as a feature collection: longitude and latitude in degrees of the site's body, and height."""
    authority, code = site.shape.map_code.split(":")
    urn = f"urn:ogc:def:crs:{authority.replace('IAU_2015', 'IAU:2015')}:{code}"
    if site.body == "Earth":
        urn = "urn:ogc:def:crs:OGC:1.3:CRS84"  # EPSG:4326 has latitude first
    content = {
        "type": "FeatureCollection",
        "name": layer.name,
        "crs": {"type": "name", "properties": {"name": urn}},
        "features": [_feature(one, layer) for one in layer.features],
    }
    return (json.dumps(content, allow_nan=False, ensure_ascii=False) + "\n").encode()


def _feature(one: Feature, layer: Layer) -> dict[str, object]:
    at = [[round(x, 9), round(y, 9), round(z, 4)] for x, y, z in one.at.tolist()]
    coordinates: object = at[0] if layer.shape == "Point" else at if layer.shape == "LineString" else [at]
    geometry = {"type": layer.shape, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": one.properties}
