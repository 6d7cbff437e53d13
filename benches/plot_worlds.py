"""Draws what `cargo run --release --example worlds` prints: the hours of a cell for a part, with touches of so many seconds.

    cargo run --release --example worlds 50 101 | python3 benches/plot_worlds.py 3 > docs/touches.svg
"""

import sys

WIDTH, BAR, GAP, LEFT, RIGHT = 860, 20, 26, 340, 80
INK, QUIET, TOUCHING, GRINDING = "#1b1b1b", "#5a5a5a", "#0072b2", "#c9c9c9"


def rows(lines):
    """Recipe, way, touches, hours of touching with touches of a second, hours of grinding."""
    for line in lines:
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if len(cells) != 9 or "," not in cells[0]:
            continue
        recipe, way = cells[0].split(", ")
        yield recipe, way, int(cells[1]), float(cells[3]), float(cells[4])


def drawn(found, touch_s):
    # The table has touches of one second: what a touch takes longer comes on top.
    bars = [(recipe, way, touches, hours + touches * (touch_s - 1) / 3600, grinding) for recipe, way, touches, hours, grinding in found]
    scale = (WIDTH - LEFT - RIGHT) / max(touching + grinding for *_, touching, grinding in bars)
    y, parts = 34, []
    text = lambda x, y, words, colour=INK, anchor="start": parts.append(
        f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" text-anchor="{anchor}">{words}</text>'
    )
    bar = lambda x, wide, colour: parts.append(f'<rect x="{x:.1f}" y="{y}" width="{wide:.1f}" height="{BAR}" fill="{colour}"/>')
    for k, (recipe, way, touches, touching, grinding) in enumerate(bars):
        if k % 2 == 0:
            y += GAP - 6
            text(8, y + BAR + 5, recipe)
        text(LEFT - 10, y + 15, f"{way}: {touches} touches", QUIET, "end")
        bar(LEFT, scale * grinding, GRINDING)
        bar(LEFT + scale * grinding, scale * touching, TOUCHING)
        text(LEFT + scale * (grinding + touching) + 8, y + 15, f"{grinding + touching:.2f} h")
        y += BAR + 4
    head = f"Hours of the cell for an accepted part, touches of {touch_s:g} s"
    parts.insert(0, f'<text x="8" y="20" fill="{INK}" font-weight="bold">{head}</text>')
    y += 14
    for x, colour, words in [(LEFT, GRINDING, "grinding"), (LEFT + 110, TOUCHING, "touching")]:
        parts.append(f'<rect x="{x}" y="{y}" width="14" height="14" fill="{colour}"/>')
        text(x + 20, y + 12, words, QUIET)
    inside = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {y + 26}" font-family="Arial, sans-serif" font-size="13">\n'
        f'<rect width="100%" height="100%" fill="#ffffff"/>\n{inside}\n</svg>'
    )


if __name__ == "__main__":
    print(drawn(list(rows(sys.stdin)), float(sys.argv[1]) if len(sys.argv) > 1 else 3.0))
