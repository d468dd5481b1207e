"""From the body of a request to a command, or to one line that says what is wrong with it."""

import time
import unicodedata
from typing import Annotated, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator
from starlette.convertors import IntegerConvertor, register_url_convertor
from starlette.requests import Request

from rovgraph.live.commands import DropMark, SetPosition

LARGEST_BODY = 4096  # [bytes]
FARTHEST_M = 1e5  # n is flat
JOINERS = "\u200c\u200d"  # of letters and emoji
BURST, PER_S = 20, 5.0  # commands that are taken at once, and a second in the long run


class _Number(IntegerConvertor):
    """A number in a path; one of thousands of digits, which Python does not convert, is none."""

    regex = "[0-9]{1,10}"


register_url_convertor("number", _Number())


class Refusal(Exception):
    """A request that is not taken: status and one line."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


def _plain(text: str) -> str:
    """Text in one line, without control characters and without those that turn its direction."""
    spaced = "".join(" " if unicodedata.category(c) in ("Cc", "Cs") else c for c in text)
    return " ".join("".join(c for c in spaced if c in JOINERS or unicodedata.category(c) != "Cf").split())


Metres = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]
Name = Annotated[str, Field(max_length=80), AfterValidator(_plain)]


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class MarkBody(_Body):
    """``POST /api/marks``: a mark where the vehicle is, or a way-point with both north and east."""

    name: Name = ""
    north: Metres | None = None
    east: Metres | None = None

    @model_validator(mode="after")
    def _both_or_none(self) -> "MarkBody":
        if (self.north is None) != (self.east is None):
            raise ValueError("north and east belong together")
        return self

    def command(self) -> DropMark:
        return DropMark(self.name, self.north, self.east)


class PositionBody(_Body):
    """``POST /api/position``: where the vehicle is now."""

    north: Metres
    east: Metres
    sd: Annotated[float, Field(ge=0.01, le=1e4, allow_inf_nan=False)]

    def command(self) -> SetPosition:
        return SetPosition(self.north, self.east, self.sd)


B = TypeVar("B", bound=_Body)


async def read_body(request: Request, kind: type[B]) -> B:
    """The body of a request.

    Raises
    ------
    Refusal : it is no JSON, too large, or not what is expected
    """
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise Refusal(415, "expected the content type application/json")
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > LARGEST_BODY:
            raise Refusal(413, f"expected at most {LARGEST_BODY} bytes")
    try:
        return kind.model_validate_json(body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise Refusal(422, f"{where}: {first['msg']}" if where else first["msg"]) from None


class Allowance:
    """How many commands are still taken: `BURST` at once, `PER_S` in the long run, of all pages together."""

    def __init__(self) -> None:
        self._left, self._at = float(BURST), time.monotonic()

    def take(self) -> None:
        """Use one.

        Raises
        ------
        Refusal : there is none left
        """
        now = time.monotonic()
        self._left = min(float(BURST), self._left + PER_S * (now - self._at))
        self._at = now
        if self._left < 1.0:
            raise Refusal(429, f"more than {PER_S:g} commands a second; wait a moment")
        self._left -= 1.0
