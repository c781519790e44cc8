"""Certificates made for a test by the `openssl` command."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest


class Authority:
    """Signs certificates; all its files are in one folder."""

    def __init__(self, folder: Path, by: Authority | None = None) -> None:
        """Make an authority whose certificate it signs itself, or another one."""
        if shutil.which("openssl") is None:
            pytest.skip("the openssl command is missing (apt install openssl)")
        self._folder = folder
        folder.mkdir()
        self.root = str(folder / "ca.pem")
        if by is None:
            self._openssl("req", "-x509", *_NEW_KEY, "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=CA")
            return
        for file in by._certify("intermediate", "basicConstraints=critical,CA:TRUE\n", days=30):
            Path(file).rename(folder / f"ca{Path(file).suffix}")

    def sign(self, name: str, host: str = "localhost", *, days: int = 30) -> tuple[str, str]:
        """Certificate and key of a computer; with negative `days` it has expired."""
        return self._certify(name, f"subjectAltName=DNS:{host}\nbasicConstraints=CA:FALSE\n", days=days)

    def _certify(self, name: str, extensions: str, *, days: int) -> tuple[str, str]:
        key, request, certificate = f"{name}.key", f"{name}.csr", f"{name}.pem"
        (self._folder / "ext").write_text(extensions)
        self._openssl("req", *_NEW_KEY, "-keyout", key, "-out", request, "-subj", f"/CN={name}")
        signed = ("-CA", "ca.pem", "-CAkey", "ca.key", "-out", certificate, "-extfile", "ext", "-days", str(days))
        self._openssl("x509", "-req", "-in", request, *signed)
        return str(self._folder / certificate), str(self._folder / key)

    def _openssl(self, *args: str) -> None:
        subprocess.run(["openssl", *args], cwd=self._folder, check=True, capture_output=True)


_NEW_KEY = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
