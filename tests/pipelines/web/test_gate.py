"""Who is let in by the gate: every refusal that it promises, and nothing else refused."""

import pytest
from mplicits.pipelines.web.gate import Gate

OWN = {"Host": "127.0.0.1:8080"}


@pytest.fixture
def gate():
    return Gate("127.0.0.1", 8080, token="tok-en_1")


def test_the_address_lets_in_and_leaves_the_token_as_a_cookie(gate):
    first = gate.admit("/?token=tok-en_1", OWN)
    assert first.admitted
    kept, *properties = first.headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Strict"} <= set(properties)
    for path in ("/", "/assets/a.js", "/?websocket"):
        assert gate.admit(path, OWN | {"Cookie": f"other=1; {kept}"}).admitted
    assert "Set-Cookie" not in gate.admit("/", OWN | {"Cookie": kept}).headers


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/", {}),
        ("/?token=", {}),
        ("/?token=tok-en_", {}),
        ("/?token=tok-en_12", {}),
        ("/?token=%C3%A4%00%F0", {}),
        ("/?other=tok-en_1", {}),
        ("/", {"Cookie": "mplicits-8081=tok-en_1"}),
        ("/", {"Cookie": "mplicits-8080=wrong"}),
        ("/", {"Cookie": 'mplicits-8080="\\'}),
        ("/", {"Cookie": "=;;=\x7f"}),
    ],
)
def test_without_the_token_nobody_comes_in_and_a_person_is_asked_for_it(gate, path, headers):
    verdict = gate.admit(path, OWN | headers)
    assert verdict.status == 403
    assert "token" in verdict.body
    assert "tok-en_1" not in str(verdict)


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "", "http://127.0.0.1:9999", "http://127.0.0.1"])
def test_other_pages_are_refused_even_with_the_token(gate, origin):
    assert gate.admit("/?token=tok-en_1", OWN | {"Origin": origin}).status == 403


def test_its_own_page_is_let_in_by_either_scheme_and_through_a_tunnel(gate):
    for host in ("127.0.0.1:8080", "localhost:9000", "[::1]:8080", "localhost.:1", "LOCALHOST"):
        for scheme in ("http", "https"):
            assert gate.admit("/?token=tok-en_1", {"Host": host, "Origin": f"{scheme}://{host}"}).admitted


@pytest.mark.parametrize("host", ["evil.example:8080", "127.0.0.1.evil.example", "", "[", "192.168.1.5:8080"])
def test_names_that_were_made_to_point_here_are_refused(gate, host):
    assert gate.admit("/?token=tok-en_1", {"Host": host}).status == 421


def test_a_server_for_others_goes_by_any_name_but_wants_the_token():
    gate = Gate("0.0.0.0", 80, token="t")
    assert gate.url == "http://127.0.0.1:80/?token=t"
    assert gate.admit("/?token=t", {"Host": "box.lan", "Origin": "http://box.lan"}).admitted
    assert gate.admit("/", {"Host": "box.lan"}).status == 403
    assert gate.admit("/?token=t", {"Host": "box.lan", "Origin": "http://evil.lan"}).status == 403


def test_tokens_are_drawn_anew_and_long():
    tokens = {Gate("127.0.0.1", 1).token for _ in range(8)}
    assert len(tokens) == 8
    assert min(map(len, tokens)) >= 20
    assert Gate("::1", 7, token="t").url == "http://[::1]:7/?token=t"
