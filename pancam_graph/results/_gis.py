"""The export for GIS programs: GeoPackage, and of a drive on a planet GeoJSON and KML."""

from pathlib import Path

from pancam_graph.base.text import visible
from pancam_graph.data import Site, Solution
from pancam_graph.results._exported import whole_export, write_export_json
from pancam_graph.results._geojson import geojson
from pancam_graph.results._geopackage import write_geopackage
from pancam_graph.results._gis_layers import Layer, gis_layers
from pancam_graph.results._output import OutputWriter, Written

__all__ = ["GIS", "write_gis"]

_KML_TARGET = {"Mars": ' hint="target=mars"', "Moon": ' hint="target=moon"', "Earth": ""}


def write_gis(solution: Solution, folder: Path | str) -> None:
    """Write `drive.gpkg`, and with a site `LAYER.geojson` and `drive.kml`, into a new folder (docs/files.md).

    Raises InputError as `whole_export` does.
    """
    with whole_export(Path(folder)) as place:
        _fill(solution, place)


def _fill(solution: Solution, folder: Path) -> None:
    site, layers = solution.traverse.site, gis_layers(solution)
    write_geopackage(folder / "drive.gpkg", layers, site)
    about: dict[str, object] = {"coordinates": "world frame of the traverse, metres"}
    if site is not None:
        about = {"coordinates": f"longitude, latitude (degrees) and height (metres) on {site.body}"}
        for layer in layers:
            if layer.features:
                (folder / f"{layer.name}.geojson").write_bytes(geojson(layer, site))
        (folder / "drive.kml").write_text(_kml(solution.traverse.name, layers, site), encoding="utf-8")
    write_export_json(folder, "gis", about)


def _kml(name: str, layers: tuple[Layer, ...], site: Site) -> str:
    """Stops and the way between them as KML."""
    from xml.sax.saxutils import escape  # noqa: PLC0415  late: it imports what opens addresses

    of = {layer.name: layer.features for layer in layers}

    def places(at: list[list[float]]) -> str:
        return " ".join(f"{x:.9f},{y:.9f},{z:.3f}" for x, y, z in at)

    marks = [
        f"<Placemark><name>{escape(visible(str(one.properties['stop'])))}</name><Point><coordinates>"
        f"{places(one.at.tolist())}</coordinates></Point></Placemark>"
        for one in of["stops"]
    ]
    marks += [
        "<Placemark><name>drive</name><LineString><tessellate>1</tessellate><coordinates>"
        f"{places(one.at.tolist())}</coordinates></LineString></Placemark>"
        for one in of["drive"]
    ]
    body = "\n".join(marks)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<kml xmlns="http://www.opengis.net/kml/2.2"{_KML_TARGET[site.body]}><Document>\n'
        f"<name>{escape(visible(name))}</name>\n{body}\n</Document></kml>\n"
    )


def _write(written: Written, folder: Path) -> Written:
    _fill(written.solution, folder)
    return written


GIS = OutputWriter(write=_write)
