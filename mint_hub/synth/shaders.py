"""What the graphics card runs, GLSL 3.30.

Positions reach the card in the body's frame and leave in clip space such that row j of the
framebuffer is row j of the image: clip y points down. Light is computed in the world's frame.
Textures hold the square root of linear reflectance.
"""

from typing import Final

NUM_LIGHTS: Final = 4
"""Lights that are drawn; the first two and the sky throw shadows."""

NUM_SHADOWS: Final = 3

_TRANSFORM: Final = """
#version 330
uniform mat4 world_from_body;
uniform mat4 camera_from_body;
uniform vec4 lens;  // of the projection: x / z and y / z at the border, then two for depth
in vec3 in_position;
vec4 clip(vec3 camera) {
    return vec4(camera.x / lens.x, camera.y / lens.y, lens.z * camera.z + lens.w, camera.z);
}
"""

BODY_VERTEX: Final = (
    _TRANSFORM
    + """
in vec3 in_normal;
in vec2 in_uv;
out vec3 position;
out vec3 normal;
out vec2 uv;
void main() {
    position = (world_from_body * vec4(in_position, 1.0)).xyz;
    normal = mat3(world_from_body) * in_normal;
    uv = in_uv;
    gl_Position = clip((camera_from_body * vec4(in_position, 1.0)).xyz);
}
"""
)

SKIN_VERTEX: Final = (
    _TRANSFORM
    + """
in vec3 in_normal;
in vec3 in_nail;
in vec2 in_rest;
in float in_phase;
out vec3 position;
out vec3 normal;
out vec3 nail;
out vec2 rest;
out float phase;
void main() {
    position = (world_from_body * vec4(in_position, 1.0)).xyz;
    normal = mat3(world_from_body) * in_normal;
    nail = in_nail;
    rest = in_rest;
    phase = in_phase;
    gl_Position = clip((camera_from_body * vec4(in_position, 1.0)).xyz);
}
"""
)

_LIGHT: Final = """
#version 330
uniform vec3 eye;
uniform vec3 focus;       // where things happen; it is darker far from it
uniform vec3 ambient;
uniform float exposure;
uniform int num_lights;
uniform int num_shadowed;
uniform vec3 to_light[4];
uniform vec3 light_colour[4];
uniform mat4 shadow_from_world[3];
uniform vec3 shadow_depth;   // metres of one unit of a shadow map's depth
uniform sampler2D shadow_0;  // mean depth of what is lit first, and mean of its square
uniform sampler2D shadow_1;
uniform sampler2D shadow_2;
out vec4 colour;

// Share of the light that arrives: Chebyshev's bound on how much of the blurred map lies behind
// (variance shadow maps, Donnelly and Lauritzen 2006), its lowest part cut off.
float lit(sampler2D map, mat4 from_world, vec3 p, float metres) {
    vec3 at = (from_world * vec4(p, 1.0)).xyz;
    vec2 moments = textureLod(map, at.xy, 0.0).xy;
    float behind = (at.z - moments.x) * metres - 0.001;
    float variance = max(moments.y - moments.x * moments.x, 0.0) * metres * metres + 1e-6;
    float share = behind <= 0.0 ? 1.0 : variance / (variance + behind * behind);
    vec2 border = abs(at.xy - 0.5);
    share = smoothstep(0.3, 0.95, share);
    return mix(share, 1.0, smoothstep(0.45, 0.495, max(border.x, border.y)));
}

// Light that arrives: diffuse in rgb; what glints, in the last. `wrap`: how far it goes round.
vec3 arriving(vec3 p, vec3 n, vec3 wrap, float shine, out vec3 glint) {
    vec3 towards = normalize(eye - p);
    float far = length(p - focus);
    float sky = lit(shadow_2, shadow_from_world[2], p, shadow_depth.z);
    float open = 0.72 + 0.28 * n.z;
    vec3 total = ambient * open * mix(0.45, 1.0, sky) / (1.0 + 0.05 * far * far);
    glint = vec3(0.0);
    float key = lit(shadow_0, shadow_from_world[0], p, shadow_depth.x);
    float second = 1.0;
    if (num_shadowed > 1) second = lit(shadow_1, shadow_from_world[1], p, shadow_depth.y);
    for (int i = 0; i < num_lights; i++) {
        float facing = dot(n, to_light[i]);
        vec3 share = max((vec3(facing) + wrap) / (1.0 + wrap), 0.0);
        float open_to = 1.0;
        if (facing > -wrap.r) {
            if (i == 0) open_to = key;
            if (i == 1) open_to = second;
        }
        vec3 light = light_colour[i] * open_to / (1.0 + 0.03 * far * far);
        total += light * share;
        float near = max(dot(n, normalize(to_light[i] + towards)), 0.0);
        glint += light * pow(near, shine) * step(0.0, facing);
    }
    return total;
}

vec4 shown(vec3 linear) {
    vec3 x = max(linear * exposure, 0.0);
    x = mix(x, 0.7 + 0.3 * (1.0 - exp(-(x - 0.7) / 0.3)), step(0.7, x));  // a soft shoulder
    return vec4(pow(x, vec3(1.0 / 2.2)), 1.0);
}
"""

BODY_FRAGMENT: Final = (
    _LIGHT
    + """
uniform sampler2D surface;
uniform float roughness;
in vec3 position;
in vec3 normal;
in vec2 uv;
void main() {
    vec3 coded = texture(surface, uv).rgb;
    vec3 glint;
    float shine = exp2(9.0 * (1.0 - roughness) + 1.5);
    vec3 light = arriving(position, normalize(normal), vec3(0.03), shine, glint);
    float strength = 0.9 * (1.0 - roughness) * (1.0 - roughness);
    colour = shown(coded * coded * light + strength * glint);
}
"""
)

SKIN_FRAGMENT: Final = (
    _LIGHT
    + """
uniform sampler2D surface;  // blotches, cells, slopes
uniform vec3 skin;
in vec3 position;
in vec3 normal;
in vec3 nail;
in vec2 rest;
in float phase;

float line(float distance, float width) { return exp(-distance * distance / (width * width)); }

float creases(float palm) {
    float d = phase - floor(phase + 0.5);
    float n = floor(phase + 0.5);
    if (n < 0.5 || n > 3.5) return 0.0;
    float mm = d * (n < 1.5 ? 40.0 : 24.0);
    if (n < 1.5) return palm * line(mm - 16.0, 0.7);  // where the finger leaves the palm
    float inner = line(mm - 0.6, 0.7) + 0.6 * line(mm + 1.4, 0.6);
    float outer = line(mm, 0.5) + 0.8 * line(mm - 2.0, 0.5) + 0.7 * line(mm + 2.2, 0.5);
    return mix(0.55 * outer, inner, palm);
}

float palm_lines() {
    if (phase > 1.05) return 0.0;
    float t = (-rest.x - 0.005) / 0.09;
    float life = 0.030 - 0.034 * (1.0 - t) * (1.0 - t) - 0.002;
    float head = 0.064 - 0.0014 * exp2(4.6 * clip01((rest.y + 0.028) / 0.052));
    float heart = 0.076 - 0.012 * clip01((0.012 - rest.y) / 0.04);
    float a = line(rest.y - life, 0.0011) * step(0.1, t) * step(t, 0.8);
    float b = line(-rest.x - head, 0.0010) * step(-0.022, rest.y) * step(rest.y, 0.026);
    float c = line(-rest.x - heart, 0.0010) * step(rest.y, 0.014);
    return max(a, max(b, c));
}

void main() {
    vec4 relief = texture(surface, rest / 0.064 + vec2(0.37, 0.13)) - 0.502;
    vec3 n = normalize(normal);
    vec3 dx = dFdx(position), dy = dFdy(position);
    vec2 ux = dFdx(rest), uy = dFdy(rest);
    vec3 along = dx * uy.y - dy * ux.y, across = dy * ux.x - dx * uy.x;
    float size = max(length(along), length(across));
    float far = clip01(0.5 / length(eye - position));
    if (size > 0.0) n = normalize(n - 0.55 * far * (relief.b * along + relief.a * across) / size);
    float palm = smoothstep(-0.15, 0.25, -nail.z);
    vec3 albedo = skin * (1.0 + 0.30 * relief.r + 0.16 * relief.g);
    float pale = palm * (1.0 - smoothstep(0.02, 0.35, skin.r));
    albedo = mix(albedo, albedo * 0.55 + vec3(0.19, 0.10, 0.075), pale);
    float knuckle = (1.0 - palm) * line((phase - floor(phase + 0.5)) * 24.0, 6.0)
        * step(0.9, phase) * step(phase, 3.5);
    float flush = 0.55 * knuckle + 0.8 * smoothstep(3.2, 4.0, phase) + 0.35 * palm + 0.5 * relief.r;
    albedo *= mix(vec3(1.0), vec3(1.02, 0.82, 0.78), clip01(flush));
    float crease = creases(palm) + palm * 0.8 * palm_lines();
    albedo *= mix(vec3(1.0), vec3(0.66, 0.52, 0.48), clip01(0.75 * crease) * far);
    float edge = pow(abs(nail.x), 3.0) + pow(abs(nail.y), 4.0);
    float on_nail = (1.0 - smoothstep(0.9, 1.15, edge)) * smoothstep(0.1, 0.3, nail.z);
    float rim = smoothstep(0.55, 0.95, edge) * on_nail;
    vec3 bed = skin * vec3(1.12, 0.98, 0.98) + vec3(0.06, 0.02, 0.02);
    vec3 plate = mix(bed, vec3(0.75, 0.68, 0.6), 0.7 * smoothstep(0.72, 0.85, nail.y));
    albedo = mix(albedo, plate * mix(1.0, 0.72, rim), 0.85 * on_nail);
    vec3 glint;
    vec3 light = arriving(position, n, vec3(0.34, 0.16, 0.12), mix(14.0, 60.0, on_nail), glint);
    float graze = pow(1.0 - clip01(dot(n, normalize(eye - position))), 4.0);
    colour = shown(albedo * light + (mix(0.035, 0.16, on_nail) + 0.10 * graze) * glint);
}
"""
).replace("float line(", "float clip01(float x) { return clamp(x, 0.0, 1.0); }\nfloat line(", 1)

SHADOW_VERTEX: Final = """
#version 330
uniform mat4 shadow_from_body;
in vec3 in_position;
void main() {
    gl_Position = vec4((shadow_from_body * vec4(in_position, 1.0)).xyz * 2.0 - 1.0, 1.0);
}
"""

SHADOW_FRAGMENT: Final = """
#version 330
void main() {}
"""

LABEL_VERTEX: Final = (
    _TRANSFORM
    + """
uniform mat4 earlier_from_body;
in vec3 in_earlier;
out vec3 now;
out vec3 before;
void main() {
    now = (camera_from_body * vec4(in_position, 1.0)).xyz;
    before = (earlier_from_body * vec4(in_earlier, 1.0)).xyz;
    gl_Position = clip(now);
}
"""
)

LABEL_FRAGMENT: Final = """
#version 330
uniform float label;
uniform vec4 lens;
uniform vec2 half_size;
in vec3 now;
in vec3 before;
layout(location = 0) out float depth;
layout(location = 1) out float segment;
layout(location = 2) out vec2 flow;
void main() {
    depth = now.z;
    segment = label / 255.0;
    float z = max(before.z, 0.01);
    flow = half_size / lens.xy * (now.xy / now.z - before.xy / z);
}
"""
