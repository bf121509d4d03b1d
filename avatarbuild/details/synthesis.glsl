// Detail maps of an expression in a shader: equations (16) and (17), GLSL ES 3.00 (WebGL 2).
//
// Paste into a vertex and a fragment shader after `#version 300 es`, `#define KEYFRAMES k`, `#define EDGES e`, the
// precisions of float, sampler2D and sampler2DArray (highp), and, where only one of the two functions is wanted,
// `#define DETAIL_DISTANCES` or `#define DETAIL_LAYERS` (without either, both are there).
//
//   vertex shader     detail_distances(uv, phi)      then hand phi on: `out float phi[KEYFRAMES]`
//   fragment shader   vec4 l = detail_layers(uv, phi)   xyz: normal in tangent space, +Y up; w: occlusion, 1 open
//                     vec3 n = detail_on(normal of the avatar's own map, l.xyz)
//
// uv is TEXCOORD_0 of avatar.glb: origin top left. The images are uploaded as they are: no flip, no colour space, not
// premultiplied. docs/formats.md names the fields of details.json that fill the uniforms. detail_distances reads 8
// texels a keyframe, detail_layers k + 1 + ceil((k + 1) / 3); both together, in a fragment, 58 for six keyframes.

#if !defined(DETAIL_DISTANCES) && !defined(DETAIL_LAYERS)
#define DETAIL_DISTANCES
#define DETAIL_LAYERS
#endif

#ifdef DETAIL_DISTANCES

// e1 of every edge in every keyframe, mm, and |e1 - e2|; e2, and ((f_e - f_ke) / spread_e)^2 with f_e held within
// strain_low … strain_high: the last number is written anew for every expression. Edges of keyframe 0 first.
layout(std140) uniform DetailEdges {
    vec4 detail_first[KEYFRAMES * EDGES];
    vec4 detail_second[KEYFRAMES * EDGES];
};
uniform sampler2D detail_positions;  // positions.png
uniform vec3 detail_low[KEYFRAMES], detail_step[KEYFRAMES];
uniform float detail_beta;

vec3 detail_texel(int key, ivec2 at, int side) {
    ivec2 place = at + ivec2(key * side, 0);
    vec3 high = texelFetch(detail_positions, place, 0).rgb, low = texelFetch(detail_positions, place + ivec2(0, side), 0).rgb;
    return detail_low[key] + detail_step[key] * floor(high * 65280.0 + low * 255.0 + 0.5);
}

vec3 detail_position(int key, vec2 uv) {
    int side = textureSize(detail_positions, 0).y / 2;
    vec2 at = clamp(uv * float(side) - 0.5, vec2(0.0), vec2(float(side - 1)));
    ivec2 corner = min(ivec2(at), ivec2(side - 2));
    vec2 part = at - vec2(corner);
    vec3 top = mix(detail_texel(key, corner, side), detail_texel(key, corner + ivec2(1, 0), side), part.x);
    vec3 bottom = mix(detail_texel(key, corner + ivec2(0, 1), side), detail_texel(key, corner + ivec2(1, 1), side), part.x);
    return mix(top, bottom, part.y);
}

void detail_distances(vec2 uv, out float phi[KEYFRAMES]) {
    for (int key = 0; key < KEYFRAMES; key++) {
        vec3 p = detail_position(key, uv);
        float least = 1e9;
        for (int e = key * EDGES; e < (key + 1) * EDGES; e++) {
            vec4 one = detail_first[e];
            least = min(least, distance(p, one.xyz) + distance(p, detail_second[e].xyz) - one.w);
        }
        float total = 0.0, square = 0.0;
        for (int e = key * EDGES; e < (key + 1) * EDGES; e++) {
            vec4 one = detail_first[e], two = detail_second[e];
            float share = exp(-detail_beta * (distance(p, one.xyz) + distance(p, two.xyz) - one.w - least));
            total += share;
            square += share * two.w;
        }
        phi[key] = sqrt(square / total);
    }
}

#endif

#ifdef DETAIL_LAYERS

uniform sampler2DArray detail_weights;  // weights_00.png and so on, one a layer
uniform vec3 detail_scale[KEYFRAMES + 1 + (KEYFRAMES + 3) / 3];
uniform float detail_centre[KEYFRAMES];

vec3 detail_weight(int slice, vec2 uv) {
    return detail_scale[slice] * (texture(detail_weights, vec3(uv, float(slice))).rgb * 255.0 - 128.0);
}

vec4 detail_layers(vec2 uv, float phi[KEYFRAMES]) {
    vec3 normal = detail_weight(0, uv), shade = detail_weight(KEYFRAMES + 1, uv);
    float occlusion = shade.r;
    for (int key = 0; key < KEYFRAMES; key++) {
        float term = phi[key] - detail_centre[key];
        normal += term * detail_weight(key + 1, uv);
        if ((key + 1) % 3 == 0) shade = detail_weight(KEYFRAMES + 1 + (key + 1) / 3, uv);
        occlusion += term * shade[(key + 1) % 3];
    }
    return vec4(normalize(normal), clamp(occlusion, 0.0, 1.0));
}

vec3 detail_on(vec3 neutral, vec3 detail) {
    return normalize(vec3(neutral.xy / max(neutral.z, 0.05) + detail.xy / max(detail.z, 0.05), 1.0));
}

#endif
