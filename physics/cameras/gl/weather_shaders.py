"""GLSL of weather: the uniform block, patterns on the ground, lamps, and the pass over a picture.

The block `Weather` (binding WEATHER_BINDING) is read by variants with WEATHER only:

    vec4 surface     wetness, share of puddles, snow cover, share of windows lit
    vec4 falling     rain and snow in the air, 0 to 1; drops on the lens, 0 to 1; bloom
    vec4 moment      time in seconds, seed 0 to 1, sensor noise, number of lamps
    vec4 night       scattering of lamplight per metre, stars, glow of fog at the sun, number of
                     people who cast shadows
    vec4 lamp_at     xyz from the anchor; w 1 / range^2
    vec4 lamp_light  rgb radiance times square metres; w row of the wall map, -1 without
    vec4 lamp_way    xyz direction; w cosine at which its light ends
    vec4 person      xyz feet, from the anchor; w height in metres
"""

from __future__ import annotations

from typing import Final

from physics.cameras.gl.splat_shaders import METRES

WEATHER_BINDING: Final = 1
LAMPS_MAX: Final = 14
PEOPLE_MAX: Final = 6
CASTING_LAMPS: Final = 3
"""Number of lamps whose light people block."""
WALLS_UNIT: Final = 16
AIR_COLOUR_UNIT: Final = 17
AIR_DEPTH_UNIT: Final = 18
WALL_ANGLES: Final = 256
CONE: Final = 0.30
"""Width of the edge of a lamp's light, as a difference of cosines."""

BLOCK: Final = f"""
layout(std140, binding = {WEATHER_BINDING}) uniform Weather {{
    vec4 surface;
    vec4 falling;
    vec4 moment;
    vec4 night;
    vec4 lamp_at[{LAMPS_MAX}];
    vec4 lamp_light[{LAMPS_MAX}];
    vec4 lamp_way[{LAMPS_MAX}];
    vec4 person[{PEOPLE_MAX}];
}};
"""

PATTERNS: Final = """
float fading(float high, float low, float x) { return 1.0 - smoothstep(low, high, x); }
float hashed(vec2 cell) {
    vec3 p = fract(cell.xyx * vec3(0.1031, 0.1030, 0.0973));
    p += dot(p, p.yzx + 33.33);
    return fract((p.x + p.y) * p.z);
}
float noise(vec2 at, float side) {
    // Value noise; the lattice repeats every 512 m, as `ground_at` does.
    vec2 cell = floor(at / side), in_cell = at / side - cell;
    in_cell = in_cell * in_cell * (3.0 - 2.0 * in_cell);
    float many = floor(512.0 / side + 0.5);
    vec4 corner = mod(vec4(cell, cell + 1.0), many);
    return mix(mix(hashed(corner.xy), hashed(corner.zy), in_cell.x),
               mix(hashed(corner.xw), hashed(corner.zw), in_cell.x), in_cell.y);
}
vec2 ground_at(vec3 at) { return mod(anchor.xy, 512.0) + at.xy; }
bool is_ground(float label) { return label > 0.5 && label < 6.5; }
float puddle(vec3 at, float label) {
    // Share of water over the ground, 0 to 1.
    if (label > 3.5 || label < 0.5) return 0.0;
    vec2 here = ground_at(at);
    float hollow = 0.55 * noise(here, 2.0) + 0.30 * noise(here, 0.8) + 0.15 * noise(here, 0.25);
    float level = 0.30 + 0.42 * surface.y;
    return fading(level + 0.035, level - 0.035, hollow);
}
"""

LAMPS: Final = f"""
layout(binding = {WALLS_UNIT}) uniform sampler2D walls_around;
float unblocked(vec3 from_lamp, float row) {{
    if (row < 0.0) return 1.0;
    float up_side = from_lamp.y / (abs(from_lamp.x) + abs(from_lamp.y) + 1.0e-6);
    float turn = 0.25 * (from_lamp.x < 0.0 ? 2.0 - up_side : up_side < 0.0 ? 4.0 + up_side : up_side);
    float wall = texture(walls_around, vec2(turn, (row + 0.5) / {LAMPS_MAX}.0)).r;
    return 1.0 - smoothstep(wall + 0.25, wall + 0.9, length(from_lamp.xy));
}}
vec3 reaching(int k, vec3 to, float far2) {{
    // Light of a lamp at a point that faces it.
    float fade = max(1.0 - far2 * lamp_at[k].w, 0.0);
    if (fade == 0.0) return vec3(0.0);
    vec3 way = to * inversesqrt(far2);
    float cone = smoothstep(lamp_way[k].w, lamp_way[k].w + {CONE}, -dot(way, lamp_way[k].xyz));
    if (cone == 0.0) return vec3(0.0);
    return lamp_light[k].rgb * (fade * fade * cone / (far2 + 0.3)) * unblocked(-to, lamp_light[k].w);
}}
float past_people(vec3 at, vec3 to) {{
    // Share of a lamp's light that people leave; each is an upright post that does not shade itself.
    float lit = 1.0, flat_m = length(to.xy);
    vec2 way = to.xy / max(flat_m, 0.01);
    int count = int(night.w);
    for (int k = 0; k < count; k++) {{
        vec2 off = person[k].xy - at.xy;
        float along = dot(off, way), aside = abs(off.x * way.y - off.y * way.x);
        float high = at.z + to.z * along / max(flat_m, 0.01) - person[k].z;
        float soft = 0.04 + 0.03 * max(along, 0.0);
        float shade = fading(0.20 + soft, 0.20 - soft, aside) * fading(person[k].w + soft, person[k].w - soft, high);
        float own = mix(0.04, 0.28, smoothstep(0.03, 0.12, at.z - person[k].z));
        lit *= 1.0 - shade * smoothstep(own, own + 0.12, along) * step(along, flat_m) * step(-0.5, high);
    }}
    return lit;
}}
vec3 lamplight(vec3 at, vec3 normal, float gloss, out vec3 mirrored) {{
    // gloss: exponent of the highlight on water, 0 without
    vec3 sum = vec3(0.0), seen = normalize(eye.xyz - at);
    mirrored = vec3(0.0);
    int count = int(moment.w);
    for (int k = 0; k < count; k++) {{
        vec3 to = lamp_at[k].xyz - at;
        float far2 = dot(to, to);
        vec3 light = reaching(k, to, far2);
        if (light.r == 0.0) continue;
        if (k < {CASTING_LAMPS}) light *= past_people(at, to);
        vec3 way = to * inversesqrt(far2);
        sum += light * max(0.12 + 0.88 * dot(normal, way), 0.0);
        if (gloss > 0.0) {{
            vec3 half_way = normalize(way + seen);
            mirrored += light * (0.04 * gloss * pow(max(dot(normal, half_way), 0.0), gloss)
                * (0.02 + 0.98 * pow(1.0 - clamp(dot(seen, half_way), 0.0, 1.0), 5.0)) * 4.0);
        }}
    }}
    return sum;
}}
"""

FOG_GLOW: Final = """
float towards_sun(vec3 ray) {
    // Henyey and Greenstein's phase function, g = 0.7, times pi.
    const float g = 0.7;
    float c = dot(ray, sun.xyz);
    return 0.25 * (1.0 - g * g) / pow(1.0 + g * g - 2.0 * g * c, 1.5);
}
vec3 fog_towards(vec3 ray) { return fog.rgb + sun_light.rgb * (night.z * towards_sun(ray)); }
"""

_REFLECTIONS: Final = """
vec3 sky_at(vec3 ray) {
    vec2 where = vec2(0.5 - atan(ray.y, ray.x) * 0.15915494, 0.5 - asin(clamp(ray.z, 0.0, 1.0)) * 0.31830989);
    return min(texture(sky, where).rgb, 6.0 * fog.rgb + 1.0e-5);
}
vec3 mirrored(vec3 at, vec3 ray, float blur) {
    // Colour that a ray from a point meets on the screen, else of the sky. 14 steps of growing length.
    vec2 size = vec2(textureSize(air, 0));
    float step_m = 0.22;
    vec3 here = at;
    for (int k = 0; k < 14; k++) {
        here += ray * step_m;
        step_m *= 1.35;
        vec4 clip = clip_from_at * vec4(here, 1.0);
        vec2 uv = 0.5 + 0.5 * clip.xy / clip.w;
        if (clip.w < 0.05 || uv.y > 1.0 || uv.y < 0.0) break;
        uv.x = clamp(uv.x, 0.002, 0.998);
        float met = metres(texelFetch(air_depth, ivec2(uv * size), 0).r);
        if (met < clip.w && clip.w - met < 2.0 * step_m + 0.25)
            return textureLod(air, uv, blur).rgb;
    }
    return sky_at(ray);
}
vec3 wetted(vec3 light, vec3 at, vec3 ray, float label, float far) {
    float pool = puddle(at, label);
    vec2 here = ground_at(at);
    // Ripples: rings of drops in puddles, the grain of the ground elsewhere.
    float grain = mix(0.05, 0.012, pool) / (1.0 + 0.08 * far);
    vec2 lean = vec2(noise(here + 7.0 * moment.x * pool, 0.11), noise(here.yx + 3.0, 0.11)) - 0.5;
    lean *= grain;
    if (pool > 0.0 && falling.x > 0.0 && far < 12.0) {
        vec2 cell = floor(here / 0.22);
        float age = fract(moment.x * 1.7 + hashed(cell));
        vec2 off = here / 0.22 - cell - 0.5 - 0.3 * (vec2(hashed(cell + 11.0), hashed(cell + 23.0)) - 0.5);
        float ring = exp(-pow((length(off) - 0.5 * age) * 22.0, 2.0)) * (1.0 - age);
        lean += 0.10 * falling.x * pool * ring * normalize(off + 1.0e-4);
    }
    vec3 normal = normalize(vec3(lean, 1.0));
    vec3 bounced = reflect(ray, normal);
    bounced.z = abs(bounced.z) + 0.003;
    float grazing = 1.0 - clamp(dot(-ray, normal), 0.0, 1.0);
    float share = (0.02 + 0.98 * pow(grazing, 5.0)) * mix(0.28 * surface.x, 0.85, pool);
    share *= label < 3.5 ? 1.0 : 0.35;
    float scale = log2(max(float(textureSize(air, 0).y) / 240.0, 1.0));
    vec3 image = mirrored(at + vec3(0.0, 0.0, 0.02), normalize(bounced), mix(3.4, 0.3 + 1.7 * falling.x, pool) + scale);
    return mix(light, image, clamp(share, 0.0, 0.9));
}
"""

_HALOS: Final = """
vec3 halos(vec3 ray, float far) {
    // Single scattering of lamps along the view: the closed form for a point light.
    vec3 sum = vec3(0.0);
    int count = int(moment.w);
    for (int k = 0; k < count; k++) {
        vec3 from = eye.xyz - lamp_at[k].xyz;
        float along = dot(from, ray);
        float near = sqrt(max(dot(from, from) - along * along, 0.02));
        float inside = (atan((far + along) / near) - atan(along / near)) / near;
        float facing = 0.35 + 0.65 * smoothstep(lamp_way[k].w - 0.3, 1.0, dot(normalize(from - along * ray + 0.001), lamp_way[k].xyz));
        sum += lamp_light[k].rgb * (inside * facing);
    }
    return sum * night.x;
}
"""

_FALLING: Final = """
vec3 rained(vec3 light, vec2 flat_ray, float far, vec3 around) {
    // Streaks in five sheets of air, as long as drops fall while the shutter is open.
    float pixel_tan = 2.0 * up.w / float(textureSize(air, 0).y);
    float away = 0.9;
    for (int k = 0; k < 5; k++) {
        away *= 1.75;
        if (away > far) break;
        vec2 at = flat_ray * away + vec2(0.13 * float(k), 0.0);
        at.x += 0.06 * at.y;
        float column = floor(at.x / 0.045);
        float chance = hashed(vec2(column, 17.0 * float(k) + 3.0));
        float fall = at.y + (7.5 + 2.0 * chance) * moment.x + 31.0 * chance;
        float row = floor(fall / 1.1);
        float drawn = hashed(vec2(column + 5.0 * float(k), mod(row, 997.0)));
        if (drawn > 0.62 * falling.x) continue;
        float along = fract(fall / 1.1) * 1.1 - 0.6 * fract(drawn * 91.0);
        float length_m = 0.16 + 0.10 * chance;
        float wide = max(0.0011, 0.55 * pixel_tan * away);
        float aside = (fract(at.x / 0.045) - 0.2 - 0.6 * fract(drawn * 37.0)) * 0.045;
        float body = fading(wide, 0.0, abs(aside)) * smoothstep(0.0, 0.05, along) * fading(length_m, length_m - 0.06, along);
        float share = body * min(0.0011 / wide, 1.0) * 0.55;
        light = mix(light, around, share);
    }
    return light;
}
vec3 snowed(vec3 light, vec2 flat_ray, float far, vec3 around) {
    float pixel_tan = 2.0 * up.w / float(textureSize(air, 0).y);
    float away = 0.8;
    for (int k = 0; k < 7; k++) {
        away *= 1.5;
        if (away > far) break;
        vec2 at = flat_ray * away;
        at.x += 0.35 * moment.x + 0.25 * sin(0.9 * moment.x + 0.7 * at.y + 2.0 * float(k));
        at.y += 1.1 * moment.x;
        float side = 0.16 + 0.012 * away;
        vec2 cell = floor(at / side);
        vec2 key = mod(cell, 997.0) + 13.0 * float(k);
        float drawn = hashed(key);
        if (drawn > 0.75 * falling.y) continue;
        vec2 middle = 0.2 + 0.6 * vec2(hashed(key + 5.0), hashed(key + 9.0));
        float radius = max(0.005 + 0.006 * fract(drawn * 57.0), 0.8 * pixel_tan * away);
        float off = length((at / side - cell - middle) * side);
        float share = fading(radius, 0.3 * radius, off) * min(0.009 / radius, 1.0);
        light = mix(light, around, 0.85 * share);
    }
    return light;
}
"""

_LENS: Final = """
vec2 dropped(vec2 uv, out float cover) {
    // Offset of the view through drops on the lens, out of focus. uv: in picture heights
    vec2 moved = vec2(0.0);
    cover = 0.0;
    for (int k = 0; k < 2; k++) {
        float side = k == 0 ? 0.17 : 0.06;
        vec2 cell = floor(uv / side);
        vec2 key = cell + vec2(57.0 * moment.y + 19.0 * float(k), 31.0 * moment.y);
        float slot = floor(moment.x / 5.0 + hashed(key + 3.0));
        key += mod(slot, 61.0) * 7.0;
        if (hashed(key) > (k == 0 ? 0.30 : 0.15) * falling.z) continue;
        float radius = side * (0.12 + 0.18 * hashed(key + 2.0));
        vec2 middle = (cell + 0.3 + 0.4 * vec2(hashed(key + 5.0), hashed(key + 8.0))) * side;
        vec2 off = (uv - middle) / radius;
        off.y *= off.y > 0.0 ? 1.05 : 0.85;
        off += 0.16 * (vec2(noise(off + 40.0 + key, 0.9), noise(off.yx + 70.0 + key, 0.9)) - 0.5);
        float r = length(off);
        if (r > 1.0) continue;
        moved = -off * (0.30 + 0.40 * sqrt(1.0 - 0.85 * r * r));
        cover = 1.0 - smoothstep(0.55, 1.0, r);
    }
    return moved;
}
"""

_SENSOR: Final = """
uint mixed(uint v) {
    v = v * 747796405u + 2891336453u;
    v = ((v >> ((v >> 28u) + 4u)) ^ v) * 277803737u;
    return (v >> 22u) ^ v;
}
float normal_noise(uint v) {
    // Sum of the four bytes of a hash: nearly normal, variance 1.
    uint h = mixed(v);
    float sum = float(h & 255u) + float((h >> 8) & 255u) + float((h >> 16) & 255u) + float(h >> 24);
    return (sum - 510.0) / 147.8;
}
vec3 sensed(vec3 x, ivec2 here) {
    uint base = uint(here.x) + 8192u * uint(here.y);
    base = mixed(base ^ mixed(uint(moment.x * 20.0 + 0.5) * 977u + uint(moment.y * 65535.0)));
    vec3 n = vec3(normal_noise(base), normal_noise(base + 1u), normal_noise(base + 2u));
    return max(x + n * sqrt(moment.z * (max(x, 0.0) + 0.03)), 0.0);
}
vec3 toned(vec3 light, ivec2 here) {
    vec3 x = light * sun_light.w;
    return on_curve(moment.z > 0.0 ? sensed(x, here) : x);
}
"""

AIR_FRAGMENT: Final = (
    f"""
layout(binding = {AIR_COLOUR_UNIT}) uniform sampler2D air;
layout(binding = {AIR_DEPTH_UNIT}) uniform sampler2D air_depth;
layout(binding = 5) uniform sampler2D sky;
in vec2 spot;
"""
    + METRES
    + "#ifdef WET\n"
    + _REFLECTIONS
    + "#endif\n#ifdef LAMPS\n"
    + _HALOS
    + "#endif\n"
    + _FALLING
    + _LENS
    + _SENSOR
    + """
void main() {
    ivec2 here = ivec2(gl_FragCoord.xy), size = textureSize(air, 0);
    float tall = float(size.y);
    float deep = texelFetch(air_depth, here, 0).r;
    vec4 own = texelFetch(air, here, 0);
    float far = metres(deep), lod = log2(max(tall / 180.0, 1.0));
    vec2 flat_ray = vec2(spot.x * right.w, -spot.y * up.w), uv = gl_FragCoord.xy / vec2(size);
    vec3 ray = ahead.xyz + flat_ray.x * right.xyz + flat_ray.y * up.xyz;
    float long_ray = length(ray);
    vec3 light = own.rgb;
#ifdef WET
    float kind = own.a * 255.0;
    if (is_ground(kind) && far < 70.0) light = wetted(light, eye.xyz + far * ray, ray / long_ray, kind, far);
#endif
#ifdef LAMPS
    if (night.x > 0.0) light += halos(ray / long_ray, min(far, 60.0) * long_ray);
#endif
    if (falling.x + falling.y > 0.0) {
        vec3 around = 0.75 * (side_light.rgb + tilt_light.rgb) + 0.7 * textureLod(air, uv, 3.5 + lod).rgb;
        if (falling.x > 0.0) light = rained(light, flat_ray, far, around);
        if (falling.y > 0.0) light = snowed(light, flat_ray, far, around);
    }
    if (falling.z > 0.0) {
        float cover;
        vec2 moved = dropped(gl_FragCoord.xy / tall, cover);
        if (cover > 0.0) {
            vec3 through = textureLod(air, clamp(uv + moved * vec2(tall / float(size.x), 1.0), 0.0, 1.0), 2.6 + lod).rgb;
            light = mix(light, max(0.94 * through, 0.8 * light), cover);
        }
    }
    if (falling.w > 0.0) {
        vec3 bloom = 0.5 * textureLod(air, uv, 2.0 + lod).rgb + 0.3 * textureLod(air, uv, 3.2 + lod).rgb + 0.2 * textureLod(air, uv, 4.4 + lod).rgb;
        light = mix(light, bloom, falling.w);
    }
    pixel = vec4(toned(light, here), own.a);
}
"""
)
