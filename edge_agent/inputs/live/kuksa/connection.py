"""Connection to a Kuksa databroker: address, certificate authority, token, and calls of
kuksa.val.v2.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from edge_agent.inputs.recording import import_optional
from schemas.errors import InputError
from schemas.runtime.commandline import is_port

SERVICE: Final = "/kuksa.val.v2.VAL/"
PORT: Final = 55555
FILES: Final = ("ca", "token")
LOOPBACK: Final = ("127.", "localhost:", "[::1]:", "unix:")


def describe_error(error: Any) -> str:  # noqa: ANN401 grpc has no types
    """Return the code and the details of a gRPC error on one line."""
    return f"{error.code().name}: {error.details()}"


class BrokerConnection:
    """Settings of a connection to a Kuksa databroker, and methods that open it.

    Attributes:
        grpc: the imported gRPC module.
        messages: module with the messages of kuksa.val.v2.
        metadata: metadata sent with each call.

    Args:
        option: command-line option or source that names the broker, for error messages.
        address: host and port.
        files: `ca`, file of the certificate authority (without it the connection does not use TLS),
            and `token`, file with a JSON web token.

    Raises:
        InputError: grpc is not installed, the port is missing, a file cannot be used, or a token
            would be sent without TLS.
    """

    def __init__(self, option: str, address: str, files: Mapping[str, str]) -> None:
        self.grpc = import_optional("grpc")
        # The core installs protobuf itself, but only a connection to a broker needs these messages.
        self.messages = import_optional("edge_agent.inputs.live.kuksa.broker_pb2")
        self._address = address
        port = address.rpartition(":")[2]
        if not address.startswith("unix:") and not is_port(port):
            raise InputError("source", f"{option!r} has no port", f"write it like 127.0.0.1:{PORT}")
        try:
            read = {name: Path(file).read_bytes() for name, file in files.items()}
        except OSError as error:
            raise InputError(
                "source",
                f"{option!r}: cannot read {error.filename} ({error.strerror})",
                "correct the path",
            ) from error
        self._authority = read.get("ca")
        if self._authority is not None and b"BEGIN CERTIFICATE" not in self._authority:
            problem = f"{option!r}: {files['ca']} has no certificate"
            raise InputError("source", problem, "give a PEM file")
        token = read.get("token", b"").decode("ascii", errors="replace").strip()
        if "token" in read and not re.fullmatch("[!-~]+", token):
            problem = f"{option!r}: {files['token']} is not a token"
            raise InputError("source", problem, "give a file with one JSON web token")
        self.metadata = (("authorization", f"Bearer {token}"),) if token else ()
        if token and self._authority is None and not address.startswith(LOOPBACK):
            raise InputError(
                "source", "the token would be sent without encryption", "give ca=FILE as well"
            )

    def open_channel(self) -> Any:  # noqa: ANN401 grpc has no types
        """Return a gRPC channel to the databroker. It connects at the first call."""
        if self._authority is None:
            return self.grpc.insecure_channel(self._address)
        return self.grpc.secure_channel(
            self._address, self.grpc.ssl_channel_credentials(self._authority)
        )

    def make_call(self, kind: Any, name: str, answer: Any) -> Any:  # noqa: ANN401
        """Return a function that calls a method of the broker's service.

        Args:
            kind: method of a gRPC channel that makes calls, e.g. unary_unary.
            name: name of the service's method.
            answer: class of the response message.
        """
        return kind(
            f"{SERVICE}{name}",
            request_serializer=lambda request: request.SerializeToString(),
            response_deserializer=answer.FromString,
        )
