"""Look of people's surfaces, as GLSL: folds, seams, prints, skin, hair and the light around them.

Everything is a function of the point on the body as modelled, so it moves with the body.
Details finer than a pixel fade out.

Inputs from the vertex shaders of `skins`:

at, normal     as for `show_linear` of shading
own            point on the body of 1.75 m as modelled, metres
unshaded       share of the sky's light that the body itself leaves, baked
albedo, trim   sRGB of the surface, and second colour of the clothes
worn           row of COATS; pattern, as in physics.people.wardrobe
"""

from __future__ import annotations

from typing import Final

from cosim.core.state import LABELS
from physics.people.body import COATS
from physics.people.wardrobe import HANGS, PATTERNS

_NAMES: Final = "".join(f"const int {coat.upper()} = {row};\n" for row, coat in enumerate(COATS))
_PATTERN_NAMES: Final = "".join(
    f"const int {name.upper().replace(' ', '_')} = {row};\n" for row, name in enumerate(PATTERNS)
)

_DETAIL: Final = """
in vec3 at; in vec3 normal; in vec3 own; in float unshaded;
flat in vec3 albedo; flat in vec3 trim; flat in ivec2 worn;
float bump(float x, float middle, float wide) {
    float t = (x - middle) / wide;
    return 1.0 / (1.0 + t * t * t * t);
}
float grain(vec3 cell) {
    return fract(sin(dot(floor(cell), vec3(12.9898, 78.233, 37.719))) * 43758.5453) - 0.5;
}
float line(float off, float half_wide, float px) {
    // share of a pixel that a line covers
    return clamp((half_wide + 0.5 * px - abs(off)) / max(px, 1e-4), 0.0, 1.0)
        * min(2.0 * half_wide / max(px, 1e-4), 1.0);
}
vec3 patterned(vec3 colour, vec3 other, int made, bool arm, bool front, float px) {
    float z = own.z, y = abs(own.y);
    float seen = clamp(1.4 - 25.0 * px, 0.0, 1.0);
    if (made == STRIPES) return mix(colour, other, smoothstep(-px, px, sin(z * 105.0) * 0.02));
    if (made == BANDS)
        return mix(colour, other, clamp((0.16 - abs(z - 1.30)) / max(px, 0.004), 0.0, 1.0));
    if (made == CHECK) {
        float both = step(0.0, sin(z * 95.0)) + step(0.0, sin((own.y + 0.4 * own.x) * 95.0));
        return mix(colour, other, mix(0.25, 0.36 * both, seen));
    }
    if (made == PRINT && front && !arm)
        return mix(colour, other, bump(own.y, 0.0, 0.085) * bump(z, 1.275, 0.07)
            * step(-0.22, grain(own * vec3(0.0, 70.0, 42.0))));
    if (made == OPEN && front && !arm) {
        float gap = 0.030 + 0.055 * clamp((z - 0.95) / 0.5, 0.0, 1.0);
        float edge = clamp((gap - y) / max(px, 0.004), 0.0, 1.0);
        return mix(colour, other, edge) * (1.0 - 0.5 * line(y - gap, 0.006, px));
    }
    if (made == ZIP && !arm) {
        float lines = front ? line(own.y, 0.005, px) + line(z - 1.06 + 0.6 * (y - 0.09), 0.004, px)
            * step(0.06, y) * step(y, 0.13) : 0.0;
        return mix(colour * (1.0 - 0.55 * min(lines, 1.0)), other, step(1.462, z));
    }
    if (made == BUTTONS && !arm) {
        float lines = front ? line(y - 0.016, 0.0025, px) : line(z - 1.38, 0.003, px);
        float buttons = front ? line(own.y, 0.006, px) * line(fract(z * 11.0) / 11.0 - 0.045, 0.006, px) : 0.0;
        colour *= 1.0 - 0.35 * lines;
        return mix(mix(colour, other, step(1.476, z) * 0.8), vec3(0.6), buttons);
    }
    if (made == KNIT)
        return colour * (1.0 + seen * 0.16 * sin(z * 420.0 * step(1.0, seen) + 40.0 * own.y)
            + 0.35 * grain(own * 90.0));
    if (made == PINSTRIPES)
        return mix(colour, other, 0.55 * line(fract(own.y * 28.0) / 28.0 - 0.018, 0.0022, px));
    if (made == DENIM) {
        float worn_off = bump(z, 0.66, 0.16) * smoothstep(-0.01, 0.06, own.x) + 0.5 * bump(z, 0.5, 0.06);
        colour *= 1.0 + 0.75 * worn_off + 0.3 * grain(own * 120.0);
        float side = line(own.x + 0.01, 0.004, px) * step(0.1, y);
        return colour * (1.0 - 0.4 * side);
    }
    if (made == SIDE_STRIPE) return mix(colour, other, line(own.x + 0.008, 0.014, px) * step(0.11, y));
    if (made == CREASE)
        return colour * (1.0 + 0.22 * line(y - 0.092, 0.004, px) * step(0.0, own.x));
    if (made == DOTS)
        return mix(colour, other, mix(0.3, step(0.12, grain(own * 38.0)), seen) * 0.8);
    return colour;
}
vec3 folded(int coat, int made, bool arm, bool hangs, float px, inout vec3 colour) {
    // lean of the normal: along the body, around it, and depth of the fold
    float z = own.z, soft, phase, aside = 0.0;
    if (hangs && z < 0.94 && !arm) {
        float turn = atan(own.y, own.x);
        phase = turn * 9.0 + 2.0 * sin(turn * 2.0 + z * 5.0);
        soft = 0.42 * smoothstep(0.98, 0.62, z);
        aside = soft * cos(phase);
        colour *= 1.0 - 0.35 * soft * (0.5 - 0.5 * sin(phase));
        return vec3(0.0, aside, soft);
    }
    vec3 p = own + 0.012 * sin(own.zxy * 27.0);
    if (coat == BOTTOM) {
        phase = p.z * 74.0 + 2.4 * sin(p.x * 25.0 + p.y * 16.0) + 1.3 * sin(p.z * 17.0 + p.y * 33.0);
        soft = 0.12 + 0.42 * bump(z, 0.49, 0.09) + 0.55 * smoothstep(0.30, 0.10, z)
            + 0.30 * bump(z, 0.85, 0.06);
    } else {
        phase = p.z * 58.0 + (arm ? 2.6 : 3.4) * sin(p.y * 15.0 + p.x * 12.0 + p.z * 4.0)
            + 1.5 * sin(p.z * 15.0 - p.y * 27.0);
        soft = arm ? 0.16 + 0.42 * bump(z, 1.17, 0.10) + 0.25 * smoothstep(1.02, 0.94, z)
            : 0.13 + 0.34 * bump(z, 1.02, 0.09) + 0.20 * bump(abs(own.y), 0.17, 0.05);
    }
    soft *= (made == CREASE || made == ZIP ? 0.7 : 1.0) * clamp(1.6 - 22.0 * px, 0.25, 1.0);
    colour *= 1.0 - 0.42 * soft * (0.5 - 0.5 * sin(phase));
    return vec3(soft * cos(phase), 0.5 * soft * cos(phase * 0.6 + 20.0 * p.y), soft);
}
"""

_SHOWN: Final = f"""
void main() {{
    vec3 n = normalize(normal), colour = decoded(albedo), glow_ = vec3(0.0);
    int coat = worn.x, made = worn.y & {HANGS - 1};
    vec3 wide = fwidth(own);
    float px = max(max(wide.x, wide.y), wide.z), shine = 0.02, soft = 0.0;
    vec3 towards = normalize(eye.xyz - at);
    bool arm = abs(own.y) > 0.190 + 0.05 * max(1.40 - own.z, 0.0);
    bool front = own.x > -0.012;
    if (coat == TOP || coat == BOTTOM) {{
        colour = patterned(colour, decoded(trim), made, arm, front, px);
        vec3 lean = folded(coat, made, arm, (worn.y & {HANGS}) != 0, px, colour);
        vec3 around = normalize(vec3(n.y, -n.x, 1e-4));
        n = normalize(n + vec3(0.0, 0.0, lean.x) + around * lean.y);
        colour *= 1.0 + 0.10 * grain(own * 55.0);
        shine = 0.10;
    }} else if (coat == SKIN || coat == LIPS) {{
        float face = smoothstep(1.50, 1.54, own.z) * step(0.03, own.x);
        float chin = face * smoothstep(1.595, 1.575, own.z);
        float cheeks = face * bump(own.z, 1.612, 0.022) * bump(abs(own.y), 0.042, 0.02);
        float sockets = face * bump(own.z, 1.652, 0.013) * bump(abs(own.y), 0.031, 0.02);
        float mouth = face * bump(own.z, 1.577, 0.006) * bump(own.y, 0.0, 0.026);
        float knuckles = (1.0 - face) * smoothstep(0.90, 0.84, own.z) * step(0.2, abs(own.y));
        colour *= mix(vec3(1.0), vec3(1.08, 0.86, 0.84), cheeks + 0.5 * knuckles);
        colour *= 1.0 - 0.35 * sockets;
        colour = mix(colour, colour * vec3(0.72, 0.42, 0.42), 0.8 * mouth);
        if (made > 0) colour *= mix(vec3(1.0), vec3(0.42, 0.40, 0.42), float(made) / 3.0 * chin);
        colour *= 1.0 + 0.05 * grain(own * 60.0);
        // light that enters skin leaves it nearby, mostly red
        float facing = dot(n, sun.xyz);
        float spread = max((facing + 0.4) / 1.4, 0.0) - max(facing, 0.0);
        glow_ += colour * vec3(0.75, 0.30, 0.20) * sun_light.rgb * spread * sunlit(at, n);
        shine = 0.25;
    }} else if (coat == HAIR || coat == FUR) {{
        float strands = sin(own.y * 330.0 + 3.0 * sin(own.z * 60.0)) * clamp(1.5 - 160.0 * px, 0.0, 1.0);
        colour *= 1.0 + 0.30 * strands + 0.30 * grain(own * 45.0);
        float along = dot(normalize(towards + sun.xyz), n);
        glow_ += (colour + 0.02) * sun_light.rgb * 0.5 * pow(max(along, 0.0), 24.0);
        shine = 0.2;
    }} else if (coat == SHOES) {{
        float sole = clamp((0.021 - own.z) / max(px, 0.003), 0.0, 1.0);
        colour = mix(colour, made == 1 ? vec3(0.75) : 0.5 * colour, sole);
        colour *= 1.0 - 0.3 * line(own.z - 0.024, 0.003, px);
        shine = made == 1 ? 0.1 : 0.5;
    }} else {{
        colour *= 1.0 + 0.10 * grain(own * 40.0);
        shine = 0.15;
    }}
    // light from the ground nearby, and what cloth and skin reflect at the edge of the outline
    vec3 above = side_light.rgb + tilt_light.rgb + flat_light.rgb;
    vec3 floor_ = above + sun_light.rgb * (max(sun.z, 0.0) * 0.8);
    float open_ = mix(1.0, unshaded, 0.9);
    float low = 0.22 * (0.62 - 0.38 * n.z) * (1.0 - 0.35 * smoothstep(0.2, 1.7, own.z));
    glow_ += colour * floor_ * (low * open_);
    float edge = 1.0 - max(dot(n, towards), 0.0);
    edge *= edge;
    glow_ += above * (0.35 * shine * edge * edge * open_);
    show_linear(colour * open_, glow_, n, at, {LABELS["person"]}.0);
}}
"""

FRAGMENT: Final = _NAMES + _PATTERN_NAMES + _DETAIL + _SHOWN
"""Fragment shader of people."""
