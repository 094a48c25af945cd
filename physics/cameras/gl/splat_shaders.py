"""Compute shaders of splats: keys, stable sort, projection, lists of tiles, and the pictures.

A pass draws several views of a cloud; their pictures are stacked in one texture. The views are in
the uniform block `Splatting` (binding VIEW_BINDING), see `Views` in `physics.cameras.gl.splats`.
Buffers are storage blocks with the bindings of the shader.

Pictures are upside down in textures: row 0 is the top one.
No shader uses atomic operations, so that the order of blending depends on no schedule.
"""

from __future__ import annotations

from typing import Final

from cosim.core.state import LABELS
from physics.cameras.view import FAR_PLANE_M, NEAR_PLANE_M

VIEW_BINDING: Final = 1
TILE_PX: Final = 8
"""Side of a tile in pixels."""
DIGITS: Final = 256
"""Values of a digit of a sort; a power of two."""
SORTED: Final = 2048
"""Pairs of a block of a sort."""
SCANNED: Final = 2048
"""Values of a block of prefix sums."""
BATCH: Final = 256
"""Splats of a tile that its invocations fetch together, with one pixel for each invocation."""
NEAR_M: Final = 0.2
"""Minimum depth of the centre of a drawn splat, metres."""
BLUR_PX2: Final = 0.3
"""Variance added to each projected splat, in square pixels, as in the training of splats."""
FULL: Final = 1.0 / 1024.0
"""Transmittance below which a pixel is full."""
STRAY: Final = 0.3
"""Maximum difference of a pixel's depth from its splat's, as a share."""
BEHIND_M: Final = 0.12
"""Distance behind the mesh from which objects are covered, metres."""
HIDDEN_M: Final = 0.5
"""Distance behind a wall of the mesh from which objects are not drawn at all, metres."""
STEEP: Final = 0.02
"""Minimum slope of a ray to the ground."""
NOTHING_M: Final = 1.0e9
"""Limit of pixels without an object."""
GROUND_LABELS: Final = (LABELS["road"], LABELS["ground"])
"""First and last label of the ground."""

OBJECTS_UNIT: Final = 9
OBJECTS_DEPTH_UNIT: Final = 10
MESH_UNIT: Final = 11
MESH_DEPTH_UNIT: Final = 12
COLOUR_UNIT: Final = 13
MEDIAN_UNIT: Final = 14
LIMITS_UNIT: Final = 15
FEET_UNIT: Final = 19
"""Texture units of a picture's layers, the last of the light left at feet; 16 to 18 are those of
`physics.cameras.gl.weather_shaders`."""

METRES: Final = f"""
float metres(float depth) {{
    return {FAR_PLANE_M * NEAR_PLANE_M} / ({FAR_PLANE_M} - {FAR_PLANE_M - NEAR_PLANE_M} * depth);
}}
"""
"""Conversion of the depth buffer to metres along the view."""

_BLOCK: Final = f"""#version 430
struct View {{
    vec4 eye;      // xyz in the frame of the splats; w focal length in pixels
    vec4 right;    // w tangent of half the width
    vec4 up;       // w tangent of half the height
    vec4 ahead;
    vec4 lattice;  // xyz of the point from which distances are sorted
}};
layout(std140, binding = {VIEW_BINDING}) uniform Splatting {{
    uvec4 sizes;   // width and height of a picture in pixels, columns and rows of its tiles
    uvec4 counts;  // splats of the cloud, views, number of the first view's picture
    View views[VIEWS];
}};
// The views of a pass share their lists: the splat s of view v has the number v * counts.x + s.
uint view_of(uint number) {{ return VIEWS == 1 ? 0u : number / counts.x; }}
"""

_LINE_INDEX: Final = "gl_GlobalInvocationID.x + gl_GlobalInvocationID.y * 4194240u"
"""Number of an invocation in a dispatch of several lines."""

KEYS: Final = (
    _BLOCK
    + f"""
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Splats {{ uvec4 splats[]; }};
layout(std430, binding = 1) readonly buffer Seen {{ uint seen[]; }};
layout(std430, binding = 2) writeonly buffer Keys {{ uint keys[]; }};
layout(std430, binding = 3) writeonly buffer Values {{ uint values[]; }};
void main() {{
    uint i = {_LINE_INDEX};
    if (i >= counts.x * counts.y) return;
    uint at = seen[i];
    if (seen[i + 1u] == at) return;
    uint view = view_of(i);
    precise vec3 d = uintBitsToFloat(splats[3u * (i - view * counts.x)].xyz) - views[view].lattice.xyz;
    precise float xx = d.x * d.x;
    precise float yy = d.y * d.y;
    precise float zz = d.z * d.z;
    precise float xy = xx + yy;
    precise float all = xy + zz;
    uint bits = floatBitsToUint(all) >> 12;
    keys[at] = min(max(bits, 251904u) - 251904u, 65535u);
    values[at] = i;
}}
"""
)
"""List the splats in view, and their keys: the bits of the squared distance.

251904 is the key of 2^-4, a distance of 0.25 m. A factor of two has 2048 steps, each below 0.03 %
of the distance.
"""

SCAN: Final = f"""#version 430
layout(local_size_x = 256) in;
layout(std430, binding = 0) buffer Values {{ uint values[]; }};
layout(std430, binding = 1) writeonly buffer Sums {{ uint sums[]; }};
uniform uint total;
shared uint parts[256];
void main() {{
    const uint EACH = {SCANNED // 256}u;
    uint t = gl_LocalInvocationID.x, first = gl_WorkGroupID.x * {SCANNED}u + t * EACH;
    uint one[EACH], sum = 0u;
    for (uint k = 0u; k < EACH; ++k) {{
        one[k] = first + k < total ? values[first + k] : 0u;
        sum += one[k];
    }}
    parts[t] = sum;
    barrier();
    for (uint step = 1u; step < 256u; step *= 2u) {{
        uint before = t >= step ? parts[t - step] : 0u;
        barrier();
        parts[t] += before;
        barrier();
    }}
    if (t == 255u) sums[gl_WorkGroupID.x] = parts[t];
    sum = parts[t] - sum;
    for (uint k = 0u; k < EACH; ++k) {{
        if (first + k <= total) values[first + k] = sum;
        sum += one[k];
    }}
}}
"""
"""Replace values by the sums of those before in their block, and write the sums of blocks.

The sum of all follows the values.
"""

ADD: Final = f"""#version 430
layout(local_size_x = 64) in;
layout(std430, binding = 0) buffer Values {{ uint values[]; }};
layout(std430, binding = 1) readonly buffer Sums {{ uint sums[]; }};
uniform uint total;
void main() {{
    uint i = {_LINE_INDEX};
    if (i < total) values[i] += sums[i / {SCANNED}u];
}}
"""
"""Add the sums of the blocks before."""

_SORTED: Final = f"""
uniform uint total;
uniform uint blocks;
uniform uint shift;
const uint EACH = {SORTED}u / LANESu;
shared uint held[{DIGITS // 2} * (LANES + 1)];  // two counters of 16 bits for each lane
uint word_of(uint digit, uint lane) {{ return (digit >> 1) * (LANESu + 1u) + lane; }}
uint bits_of(uint digit) {{ return (digit & 1u) << 4; }}
uint digit_of(uint key) {{ return (key >> shift) & {DIGITS - 1}u; }}
"""
"""Counters of the digits of a block. Odd strides spread them over the banks of the memory."""

COUNT: Final = (
    """#version 430
layout(local_size_x = LANES) in;
layout(std430, binding = 0) writeonly buffer Counts { uint counts[]; };
layout(std430, binding = 1) readonly buffer Keys { uint keys[]; };
"""
    + _SORTED
    + f"""
void main() {{
    uint lane = gl_LocalInvocationID.x, block = gl_WorkGroupID.x;
    for (uint d = 0u; d < {DIGITS}u; d += 2u) held[word_of(d, lane)] = 0u;
    for (uint k = 0u; k < EACH; ++k) {{
        uint i = block * {SORTED}u + k * LANESu + lane;
        if (i >= total) break;
        uint digit = digit_of(keys[i]);
        held[word_of(digit, lane)] += 1u << bits_of(digit);
    }}
    barrier();
    for (uint d = 2u * lane; d < {DIGITS}u; d += 2u * LANESu) {{
        uint sum = 0u;
        for (uint l = 0u; l < LANESu; ++l) sum += held[word_of(d, l)];
        counts[d * blocks + block] = sum & 0xffffu;
        counts[(d + 1u) * blocks + block] = sum >> 16;
    }}
}}
"""
)
"""Count the keys of each block by digit: one group for each block."""

SCATTER: Final = (
    """#version 430
layout(local_size_x = LANES) in;
layout(std430, binding = 0) readonly buffer Counts { uint counts[]; };
layout(std430, binding = 1) readonly buffer Keys { uint keys[]; };
layout(std430, binding = 2) readonly buffer Values { uint values[]; };
layout(std430, binding = 3) writeonly buffer KeysOut { uint keys_out[]; };
layout(std430, binding = 4) writeonly buffer ValuesOut { uint values_out[]; };
"""
    + _SORTED
    + f"""
shared uint staged[{SORTED} + LANES];
shared uint starts[{DIGITS}];
void main() {{
    uint lane = gl_LocalInvocationID.x, first = gl_WorkGroupID.x * {SORTED}u;
    uint items = min(total - first, {SORTED}u);
    for (uint d = 0u; d < {DIGITS}u; d += 2u) held[word_of(d, lane)] = 0u;
    for (uint i = lane; i < items; i += LANESu) staged[i + i / EACH] = keys[first + i];
    for (uint d = lane; d < {DIGITS}u; d += LANESu) starts[d] = counts[d * blocks + gl_WorkGroupID.x];
    barrier();
    uint begin = min(lane * EACH, items), end = min(begin + EACH, items);
    for (uint i = begin; i < end; ++i) {{
        uint digit = digit_of(staged[i + lane]);
        held[word_of(digit, lane)] += 1u << bits_of(digit);
    }}
    barrier();
    for (uint d = 2u * lane; d < {DIGITS}u; d += 2u * LANESu) {{
        uint sum = 0u;
        for (uint l = 0u; l < LANESu; ++l) {{
            uint one = held[word_of(d, l)];
            held[word_of(d, l)] = sum;
            sum += one;
        }}
    }}
    barrier();
    for (uint i = begin; i < end; ++i) {{
        uint key = staged[i + lane];
        uint digit = digit_of(key), word = word_of(digit, lane);
        uint before = held[word];
        held[word] = before + (1u << bits_of(digit));
        uint at = starts[digit] + ((before >> bits_of(digit)) & 0xffffu);
        keys_out[at] = key;
        values_out[at] = values[first + i];
    }}
}}
"""
)
"""Move pairs to their places, in the order of the input within a digit.

Each lane moves EACH pairs in a row. counts: sums of those before, by digit and then by block.
"""

PROJECT: Final = (
    _BLOCK
    + f"""
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Splats {{ uvec4 splats[]; }};
layout(std430, binding = 1) writeonly buffer Tiles {{ uint tiles[]; }};
#ifndef CULL
layout(std430, binding = 2) readonly buffer Order {{ uint order[]; }};
layout(std430, binding = 3) writeonly buffer Records {{ uvec4 records[]; }};
layout(std430, binding = 4) writeonly buffer Rects {{ uvec2 rects[]; }};
layout(std430, binding = 5) writeonly buffer Slopes {{ vec2 slopes[]; }};
#endif
uniform uint total;
const float SCALE = 0.84932180;  // sqrt(log2(e) / 2)
const float FAINTEST = -7.99435344;  // log2(1 / 255)
void main() {{
    uint i = {_LINE_INDEX};
    if (i >= total) return;
#ifdef CULL
    uint number = i;
#else
    uint number = order[i];
    rects[i] = uvec2(0u);
#endif
    tiles[i] = 0u;
    uint view = view_of(number), s = 3u * (number - view * counts.x);
    vec4 eye = views[view].eye, right = views[view].right;
    vec4 up = views[view].up, ahead = views[view].ahead;
    uvec4 centre = splats[s];
    vec3 d = uintBitsToFloat(centre.xyz) - eye.xyz;
    float z = dot(ahead.xyz, d);
    uint rgba = centre.w;
    float opacity = float(rgba >> 24) / 255.0;
    if (!(z > {NEAR_M}) || opacity < 1.0 / 255.0) return;
    float x = dot(right.xyz, d) / z, y = dot(up.xyz, d) / z;
    vec4 first = uintBitsToFloat(splats[s + 1u]);
    vec4 second = uintBitsToFloat(splats[s + 2u]);
    float cx = clamp(x, -1.3 * right.w, 1.3 * right.w);
    float cy = clamp(y, -1.3 * up.w, 1.3 * up.w);
    vec3 ju = (right.xyz - cx * ahead.xyz) * (eye.w / z);
    vec3 jv = (cy * ahead.xyz - up.xyz) * (eye.w / z);
    vec3 col = vec3(first.x, first.y, first.w);
    vec3 u = vec3(dot(ju, col), ju.y * first.z + ju.z * second.x, ju.z * second.y);
    vec3 v = vec3(dot(jv, col), jv.y * first.z + jv.z * second.x, jv.z * second.y);
    float uu = dot(u, u), vv = dot(v, v), b = dot(u, v);
    vec3 n = cross(u, v);
    float a = uu + {BLUR_PX2}, c = vv + {BLUR_PX2};
    float det = dot(n, n) + {BLUR_PX2} * (uu + vv) + {BLUR_PX2 * BLUR_PX2};
    float lo = log2(opacity);
    float reach = sqrt(max(lo - FAINTEST, 0.0)) / SCALE;
    vec2 at = 0.5 * vec2(sizes.xy) + eye.w * vec2(x, -y);
    vec2 half_px = reach * sqrt(vec2(a, c)) + 0.01;
    vec2 low = max(floor((at - half_px) / {TILE_PX}.0), vec2(0.0));
    vec2 high = min(floor((at + half_px) / {TILE_PX}.0) + 1.0, vec2(sizes.zw));
    if (!all(lessThan(low, high))) return;
#ifdef CULL
    tiles[i] = 1u;
#else
    tiles[i] = uint(high.x - low.x) * uint(high.y - low.y);
    uint row = view * sizes.w;
    rects[i] = uvec2(uint(low.x) | (row + uint(low.y)) << 16, uint(high.x) | (row + uint(high.y)) << 16);
    float root = sqrt(c * det);
    uint marks = (rgba & 0xffffffu) | (second.z > 0.5 ? 0x1000000u : 0u);
    mat3 lower = mat3(col, vec3(0.0, first.z, second.x), vec3(0.0, 0.0, second.y));
    vec3 w = lower * (ahead.xyz * lower), flat_u = lower * u, flat_v = lower * v;
    float zu = dot(w, flat_u), zv = dot(w, flat_v), ff = dot(flat_u, flat_v);
    uu = dot(flat_u, flat_u);
    vv = dot(flat_v, flat_v);
    n = cross(flat_u, flat_v);
    slopes[i] = vec2(vv * zu - ff * zv, uu * zv - ff * zu) / max(dot(n, n) + 1e-4 * uu * vv, 1e-37);
    records[2u * i] = floatBitsToUint(vec4(at, SCALE * c / root, -SCALE * b / root));
    records[2u * i + 1u] = uvec4(floatBitsToUint(vec3(SCALE / sqrt(c), lo, z)), marks);
#endif
}}
"""
)
"""Project splats in their order to records of 8 words, to rectangles and numbers of tiles.

CULL: write only whether each splat is in each view. The tiles of a view follow those of the views
before.

A record is the pixel, three factors of the inverse covariance, log2 of the opacity, the depth, and
the colour with the mark of the ground. Slopes are those of the depth in metres per pixel, of the
splat with its standard deviations squared, and so nearly flat.
The factors have no cancellation in long, thin splats.
"""

EMIT: Final = (
    _BLOCK
    + """
layout(local_size_x = LANES) in;
layout(std430, binding = 0) readonly buffer Rects { uvec2 rects[]; };
layout(std430, binding = 1) readonly buffer Before { uint before[]; };
layout(std430, binding = 2) writeonly buffer Keys { uint keys[]; };
layout(std430, binding = 3) writeonly buffer Values { uint values[]; };
uniform uint drawn;  // splats
uniform uint span;   // pairs of an invocation
uniform uint total;
uint splat_of(uint pair) {
    uint low = 0u, high = drawn;
    while (low + 1u < high) {
        uint middle = (low + high) / 2u;
        if (before[middle] <= pair) low = middle; else high = middle;
    }
    return low;
}
void main() {
    uint pair = gl_GlobalInvocationID.x * span;
    uint end = min(pair + span, total);
    if (pair >= end) return;
    uint i = splat_of(pair), x, y, x0, x1, y1, nth = pair - before[i];
    uvec2 rect = rects[i];
    for (bool begins = true; pair < end; ++pair) {
        if (begins) {
            x0 = rect.x & 0xffffu;
            x1 = rect.y & 0xffffu;
            y1 = rect.y >> 16;
            x = x0 + nth % (x1 - x0);
            y = (rect.x >> 16) + nth / (x1 - x0);
        }
        keys[pair] = y * sizes.z + x;
        values[pair] = i;
        x += 1u;
        if (x == x1) { x = x0; y += 1u; }
        begins = y == y1 && pair + 1u < end;
        nth = 0u;
        rect.y = begins ? 0u : 1u;
        for (uint step = 0u; step < 8u && rect.y == 0u; ++step) rect = rects[++i];
        if (begins && rect.y == 0u) {
            i = splat_of(pair + 1u);
            rect = rects[i];
        }
    }
}
"""
)
"""List the pairs of tile and splat in the order of the splats, the same number by each invocation.

llvmpipe ends the loops of an invocation after 65535 iterations, so no loop goes over all tiles.
"""

STARTS: Final = """#version 430
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Keys { uint keys[]; };
layout(std430, binding = 1) writeonly buffer Starts { uint starts[]; };
uniform uint tiles;
uniform uint total;
void main() {
    uint tile = gl_GlobalInvocationID.x;
    if (tile > tiles) return;
    uint low = 0u, high = total;
    while (low < high) {
        uint middle = (low + high) / 2u;
        if (keys[middle] < tile) low = middle + 1u; else high = middle;
    }
    starts[tile] = low;
}
"""
"""Find where the sorted pairs of each tile start."""

PAINT: Final = (
    _BLOCK
    + f"""
layout(local_size_x = {TILE_PX}, local_size_y = DOWN) in;
layout(std430, binding = 0) readonly buffer Records {{ uvec4 records[]; }};
layout(std430, binding = 1) readonly buffer Starts {{ uint starts[]; }};
layout(std430, binding = 2) readonly buffer Lists {{ uint lists[]; }};
layout(std430, binding = 3) readonly buffer Slopes {{ vec2 slopes[]; }};
layout(rgba16f, binding = 0) writeonly uniform image2D painted;
layout(r32f, binding = 1) writeonly uniform image2D median;
#ifdef LIMITED
layout(binding = {LIMITS_UNIT}) uniform sampler2D limits;
#endif
const uint NONE = 0xffffffffu;
#if ROWS == 1
const uint GROUP = {TILE_PX * TILE_PX}u, EACH = {BATCH}u / GROUP;
shared uint held[{BATCH}];
shared vec4 held_first[{BATCH}];
shared uvec4 held_second[{BATCH}];
shared uint open_of[GROUP], kept_of[GROUP];
#endif
float depth_at(uint record, vec2 pixel) {{
    float z = uintBitsToFloat(records[record + 1u].z);
    float slope = dot(slopes[record / 2u], pixel - uintBitsToFloat(records[record].xy));
    return z * z / (z - clamp(slope, -{STRAY} * z, {STRAY} * z));
}}
vec2 at;
float left[ROWS], limit[ROWS];
uint middle[ROWS];
vec3 sum[ROWS];
bool paint(uint r, vec4 one, uvec4 second) {{
    // Blend a splat; return whether all pixels of the invocation are full.
    vec3 two = uintBitsToFloat(second.xyz);
    uint rgb = second.w;
    vec3 colour = vec3(rgb & 0xffu, (rgb >> 8) & 0xffu, (rgb >> 16) & 0xffu);
    vec2 off = at - one.xy;
    float most = 0.0;
    for (int j = 0; j < ROWS; ++j) {{
        float y = off.y + float(j);
        precise float px = one.z * off.x;
        precise float py = one.w * y;
        precise float p = px + py;
        precise float q = two.x * y;
        precise float power = two.y - (p * p + q * q);
        float share = power > -7.99435344 ? left[j] * exp2(power) : 0.0;
#ifdef LIMITED
        bool ground = rgb >= 0x1000000u;
        share = two.z < (ground ? limit[j] : abs(limit[j])) ? share : 0.0;
#endif
        share = left[j] < {FULL} ? 0.0 : share;
        sum[j] += share * colour;
        left[j] -= share;
        middle[j] = middle[j] == NONE && left[j] < 0.5 ? r : middle[j];
#ifdef LIMITED
        most = max(most, limit[j] == 0.0 ? 0.0 : left[j]);
#else
        most = max(most, left[j]);
#endif
    }}
    return most < {FULL};
}}
#if ROWS == 1
uint bytes_of(uint bits) {{ return (bits * 0x204081u) & 0x1010101u; }}
bool touches(uint record, vec2 corner, uvec2 open) {{
    // Return whether a splat may reach an open pixel. open: a byte for each row of the tile
    vec4 one = uintBitsToFloat(records[record]);
    vec2 two = uintBitsToFloat(records[record + 1u].xy);
    float reach = 1.001 * sqrt(max(two.y + 7.99435344, 0.0));
    vec2 half_px = reach / two.x * vec2(length(vec2(one.w, two.x)) / one.z, 1.0) + 0.02;
    vec2 middle_px = one.xy - corner - 0.5;
    ivec2 low = ivec2(clamp(ceil(middle_px - half_px), 0.0, {TILE_PX}.0));
    ivec2 high = ivec2(clamp(floor(middle_px + half_px), -1.0, {TILE_PX - 1}.0));
    if (any(greaterThan(low, high))) return false;
    uvec2 bits = (uvec2(2u) << uvec2(high)) - (uvec2(1u) << uvec2(low));
    uvec2 reached = uvec2(bytes_of(bits.y & 15u), bytes_of(bits.y >> 4)) * bits.x;
    return (reached & open) != uvec2(0u);
}}
#endif
void main() {{
    uint view = VIEWS == 1 ? 0u : gl_WorkGroupID.y / sizes.w;
    ivec2 here = ivec2(gl_GlobalInvocationID.xy) * ivec2(1, ROWS);
    here.y -= int(view * sizes.w * {TILE_PX}u);
    ivec2 picture = ivec2(0, (view + counts.z) * sizes.y);
    at = vec2(here) + 0.5;
    uint tile = gl_WorkGroupID.y * sizes.z + gl_WorkGroupID.x;
    for (int j = 0; j < ROWS; ++j) {{
        left[j] = 1.0;
        middle[j] = NONE;
        sum[j] = vec3(0.0);
#ifdef LIMITED
        limit[j] = texelFetch(limits, picture + min(here + ivec2(0, j), ivec2(sizes.xy) - 1), 0).r;
#endif
    }}
    uint end = starts[tile + 1u];
#if ROWS == 1
    uint lane = gl_LocalInvocationIndex;
    vec2 corner = vec2(here - ivec2(gl_LocalInvocationID.xy));
    bool full = false;
#ifdef LIMITED
    full = limit[0] == 0.0;
#endif
    for (uint start = starts[tile]; start < end; start += {BATCH}u) {{
        open_of[lane] = full ? 0u : 1u;
        barrier();
        uvec2 open = uvec2(0u);
        for (uint l = 0u; l < 32u; ++l) open |= uvec2(open_of[l], open_of[l + 32u]) << l;
        if (open == uvec2(0u)) break;
        uint first = start + lane * EACH, keeps = 0u;
        for (uint k = 0u; k < EACH && first + k < end; ++k)
            keeps |= touches(2u * lists[first + k], corner, open) ? 1u << k : 0u;
        kept_of[lane] = uint(bitCount(keeps));
        barrier();
        uint count = 0u, to = 0u;
        for (uint l = 0u; l < GROUP; ++l) {{
            to += l < lane ? kept_of[l] : 0u;
            count += kept_of[l];
        }}
        for (uint k = 0u; k < EACH; ++k) {{
            if ((keeps >> k & 1u) == 0u) continue;
            held[to] = 2u * lists[first + k];
            held_first[to] = uintBitsToFloat(records[held[to]]);
            held_second[to] = records[held[to] + 1u];
            ++to;
        }}
        barrier();
        for (uint k = 0u; k < count && !full; ++k)
            full = paint(held[k], held_first[k], held_second[k]);
    }}
#else
#define NEXT {{ uint r = 2u * lists[k++]; full = paint(r, uintBitsToFloat(records[r]), records[r + 1u]); }}
    bool full = false;
    for (uint k = starts[tile]; k < end && !full;) {{
        NEXT
#ifdef LONG
        {"if (k < end) NEXT " * 7}
#endif
    }}
#endif
    for (int j = 0; j < ROWS; ++j) {{
        ivec2 pixel = here + ivec2(0, j);
        if (all(lessThan(pixel, ivec2(sizes.xy)))) {{
            imageStore(painted, picture + pixel, vec4(sum[j] / 255.0, left[j]));
            imageStore(median, picture + pixel, vec4(middle[j] == NONE ? 0.0 : depth_at(middle[j], vec2(pixel) + 0.5)));
        }}
    }}
}}
"""
)
"""Blend the splats of a tile from front to back until each pixel is full.

Invocations of one pixel fetch a batch together, without the splats that reach only full pixels:
tiles with sky have long lists.
limits: depth up to which splats are drawn; negative where ground splats are not, 0 for none.
Each invocation draws ROWS pixels of a column. LONG: for lists that are too long for a loop. The median depth is that of the splat's plane: its
inverse is linear in the picture.
"""

LIMITS: Final = (
    _BLOCK
    + f"""
layout(local_size_x = {TILE_PX}, local_size_y = {TILE_PX}) in;
layout(r32f, binding = 0) writeonly uniform image2D limits;
layout(binding = {OBJECTS_DEPTH_UNIT}) uniform sampler2D objects_depth;
layout(binding = {MESH_UNIT}) uniform sampler2D mesh;
layout(binding = {MESH_DEPTH_UNIT}) uniform sampler2D mesh_depth;
uniform uint nth;  // view
{METRES}
void main() {{
    uint view = VIEWS == 1 ? 0u : nth;
    vec4 eye = views[view].eye, right = views[view].right;
    vec4 up = views[view].up, ahead = views[view].ahead;
    ivec2 here = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(here, ivec2(sizes.xy)))) return;
    float object = texelFetch(objects_depth, here, 0).r;
    float limit = {NOTHING_M:.1f};
    if (object < 1.0) {{
        float label = texelFetch(mesh, here, 0).a * 255.0;
        float gap = metres(object) - metres(texelFetch(mesh_depth, here, 0).r);
        float y = (0.5 * float(sizes.y) - float(here.y) - 0.5) / eye.w;
        float x = (float(here.x) + 0.5 - 0.5 * float(sizes.x)) / eye.w;
        float steep = abs(ahead.z + x * right.z + y * up.z);
        bool ground = label < {GROUND_LABELS[1]}.5 && label > {GROUND_LABELS[0]}.0 - 0.5;
        float behind = ground ? gap * max(steep, {STEEP}) : gap;
        limit = behind < {BEHIND_M} ? 0.0 : ground ? metres(object) : -metres(object);
        if (!ground && behind > {HIDDEN_M}) limit = {NOTHING_M:.1f};
    }}
    imageStore(limits, here + ivec2(0, (nth + counts.z) * sizes.y), vec4(limit));
}}
"""
)
"""Decide by the mesh which splats may cover an object.

An object is covered where it is BEHIND_M behind the mesh: below ground measured vertically, because
the noise of a scan's ground is long in a flat view. HIDDEN_M behind a wall it is not drawn, because
splats have gaps.
"""
