"""Readers: sizes of archives and images are compared with a bound before they are unpacked."""

import io
import zipfile

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.base.files import xml_root
from cvqmpt_lab.base.readers import read_arrays


def npz(**arrays):
    """The content of a compressed NPZ file."""
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def test_arrays_are_read_as_numpy_reads_them():
    given = {
        "q": np.arange(12.0).reshape(3, 4).T,
        "names": np.array(["a", "bc"]),
        "none": np.empty((0, 7)),
        "one": np.array(2),
    }
    found = read_arrays(npz(**given))
    assert list(found) == list(given)
    for name, array in given.items():
        assert found[name].dtype == array.dtype and found[name].flags.writeable
        np.testing.assert_array_equal(found[name], array)


def test_an_archive_larger_than_the_bound_is_refused_before_it_is_unpacked(monkeypatch):
    zeros = npz(q=np.zeros((100_000, 7)))
    assert len(zeros) < 10_000
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda *_: pytest.fail("unpacked"))
    refused("unpacks to 5600128 bytes, at most 1000000 are read", read_arrays, zeros, 10**6)


def test_headers_that_state_another_size_are_refused():
    """An array of 8 GB is claimed by a header of 100 bytes; bzip2 packs a million times smaller."""
    header = io.BytesIO()
    stated = {"descr": "<f8", "fortran_order": False, "shape": (10**9,)}
    np.lib.format.write_array_header_1_0(header, stated)
    for method, told in (
        (zipfile.ZIP_STORED, r"its header says shape \(1000000000,\) of float64"),
        (zipfile.ZIP_BZIP2, "'q.npy' is compressed in a way that numpy does not write"),
    ):
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", method) as archive:
            archive.writestr("q.npy", header.getvalue())
        refused(told, read_arrays, file.getvalue())
    refused("Python objects", read_arrays, npz(q=np.array([print], dtype=object)))


def test_entities_of_xml_are_refused():
    """Nine levels of ten entities each are a billion; others name files."""
    for entity in ('<!ENTITY a "xxxxxxxxxx">', '<!ENTITY a SYSTEM "file:///etc/passwd">'):
        text = f'<?xml version="1.0"?><!DOCTYPE robot [{entity}]><robot name="&a;"/>'
        refused("cannot read URDF x: it declares the entity 'a'", xml_root, text, "URDF x")
