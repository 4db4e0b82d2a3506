"""The option --cluster, and what of a cache is left where a cluster fails."""

from pathlib import Path

import pytest

from pancam_graph.base.errors import ClusterError, InputError
from pancam_graph.cli import main
from pancam_graph.cli._resumable import resumable
from pancam_graph.images import cache_folder, is_cache
from pancam_graph.images._cache_folder import begin_cache


@pytest.mark.parametrize("address", ["here", "local:0"])
def test_an_address_that_is_none_is_one_sentence(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["refine", str(tmp_path), "--out", str(tmp_path / "out"), "--cluster", address]
    assert main(words) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].startswith(f"cluster '{address}': expected the address of a Dask scheduler, as tcp://")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("error", "stays"), [(ClusterError("gone"), True), (InputError("wrong"), False)])
def test_a_cluster_that_breaks_down_leaves_what_was_found(
    error: Exception, stays: bool, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with pytest.raises(type(error)), resumable(out):
        begin_cache(cache_folder(out))
        (cache_folder(out) / "mask-1.npz").write_bytes(b"found")
        raise error
    assert is_cache(cache_folder(out)) is stays
    assert out.exists() is stays


def test_a_cluster_that_is_refused_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(ClusterError), resumable(out):
        begin_cache(cache_folder(out))
        raise ClusterError("another version")
    assert not out.exists()
