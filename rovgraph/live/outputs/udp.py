"""JSON lines as datagrams."""

import socket
from collections.abc import Iterator

from rovgraph.errors import InputError
from rovgraph.live.outputs.lines import json_line
from rovgraph.live.outputs.output import Output
from rovgraph.live.outputs.url import Url
from rovgraph.live.solution import Solution
from rovgraph.live.warnings import Warnings


class UdpOutput(Output):
    """One JSON line per datagram; whether anybody listens is not known.

    Raises
    ------
    InputError : a host that cannot be found
    """

    def __init__(self, url: Url, warnings: Warnings | None = None) -> None:
        super().__init__(url, warnings)
        host, port = url.host_port()
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(found[0], socket.SOCK_DGRAM)
        except OSError as error:
            raise InputError(f"output {url.text!r}: {host} cannot be found ({error.strerror})") from None
        self._address = found[4]
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

    def _send(self, solution: Solution) -> None:
        for datagram in self._datagrams(solution):
            try:
                self._socket.sendto(datagram, self._address)
            except OSError as error:
                self._drop(1, "unreachable", f"cannot be sent ({error.strerror})")

    def _datagrams(self, solution: Solution) -> Iterator[bytes]:
        yield json_line(solution)

    def close(self) -> None:
        self._socket.close()
