"""Certificates made for a test by the `openssl` command."""

import shutil
import subprocess
from pathlib import Path

import pytest


class Authority:
    """Signs certificates; all its files are in one folder."""

    def __init__(self, folder: Path) -> None:
        if shutil.which("openssl") is None:
            pytest.skip("the openssl command is missing (apt install openssl)")
        self._folder = folder
        folder.mkdir()
        self.root = str(folder / "ca.pem")
        self._openssl("req", "-x509", "-newkey", "ec", *_EC, "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=CA")

    def sign(self, name: str, host: str = "localhost", *, days: int = 30) -> tuple[str, str]:
        """Certificate and key of a computer; with negative `days` it has expired."""
        key, request, certificate = f"{name}.key", f"{name}.csr", f"{name}.pem"
        (self._folder / "ext").write_text(f"subjectAltName=DNS:{host}\nbasicConstraints=CA:FALSE\n")
        self._openssl("req", "-newkey", "ec", *_EC, "-keyout", key, "-out", request, "-subj", f"/CN={name}")
        signed = ("-CA", "ca.pem", "-CAkey", "ca.key", "-out", certificate, "-extfile", "ext", "-days", str(days))
        self._openssl("x509", "-req", "-in", request, *signed)
        return str(self._folder / certificate), str(self._folder / key)

    def _openssl(self, *args: str) -> None:
        subprocess.run(["openssl", *args], cwd=self._folder, check=True, capture_output=True)


_EC = ("-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
