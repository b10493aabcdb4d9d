"""recordings/README.md describes what is written: its generated part is the schema's own words."""

from pathlib import Path

from far_app.recording.schema import LINES, SCHEMA_VERSION, TOPICS, describe, json_schemas

README = Path(__file__).resolve().parents[2] / "recordings/README.md"
BEGIN, END = "<!-- schema: begin -->\n", "<!-- schema: end -->\n"


def renew() -> None:
    """Write the generated part anew."""
    before, rest = README.read_text(encoding="utf-8").split(BEGIN)
    README.write_text(before + BEGIN + "\n" + describe() + "\n" + END + rest.split(END)[1], encoding="utf-8")


def test_the_generated_part_is_what_the_schema_says() -> None:
    part = README.read_text(encoding="utf-8").split(BEGIN)[1].split(END)[0]
    assert part.strip() == describe().strip(), (
        "a recorded value has changed; renew recordings/README.md with: "
        'python -c "from tests.recording.test_readme import renew; renew()"'
    )


def test_every_topic_every_field_and_every_line_is_described() -> None:
    text = README.read_text(encoding="utf-8")
    assert f"schema version {SCHEMA_VERSION}" in text.lower()
    for topic in TOPICS:
        assert f"### {topic.name} ({topic.schema_name})" in text
        assert topic.name in text.split(BEGIN)[0], f"{topic.name} is missing in the overview"
        for name in json_schemas()[topic.name]["properties"]:
            assert f"| `{name}` |" in text
    for event in LINES:
        assert f"| `{event}` |" in text
