// How skin, eyes, teeth and the inside of the mouth are lit.
//
//   L = c o s(n) + c wrap(n.l) key V + spec       c albedo, o occlusion, s the light of equation (1), V the shadow
//
// Skin scatters light below its surface, red the furthest: each colour sees a normal between the smooth and the detailed
// one, and the key light reaches round the terminator, red the furthest. Specular: two GGX lobes. Surroundings are nine
// harmonics for what is diffuse and a few spherical Gaussians over a gradient for what is mirrored: no texture is read.
//
// Texture reads of a skin fragment: albedo, normal, occlusion 3, details 10, shadow 17.
// Sources: Walter et al. 2007 (GGX); Penner and Borshukov 2011 (normals by colour); Jimenez et al. 2016 (occlusion by
// colour); Karis 2014 (environment BRDF); Wang et al. 2009 (spherical Gaussians).

#include <common>
#include <packing>
#include <lights_pars_begin>
#include <shadowmap_pars_fragment>

#define LOBES 6

// at the centroid: a sliver of a triangle would continue its normals far beyond its corners
centroid varying vec3 seenAt, localAt, facing;
varying vec2 place;
#ifdef SKIN
centroid varying vec4 along, kind;
#ifdef KEYFRAMES
centroid varying float apart[KEYFRAMES];
#endif
#endif

uniform sampler2D map;
uniform vec3 surroundings[9];           // y of equation (1), in the surroundings' own axes
uniform vec3 lobe_axis[LOBES], lobe_light[LOBES];
uniform float lobe_sharpness[LOBES];
uniform int lobes;
uniform vec3 sky[3];                    // mirrored light from above, ahead, below
uniform mat3 turned;                    // scene to the surroundings' axes
uniform vec3 key_direction, key_light;
uniform vec3 clay;
uniform vec3 mouth;                     // metres: front of the lips' gap, in the head's axes: y, z; z: its height
uniform bool show_albedo, show_details, show_occlusion, show_relief, show_normals, show_skin_light;
uniform float roughness;

#ifdef SKIN
uniform sampler2D normal_map, occlusion_map;
uniform float relief_strength;
#endif
#ifdef EYE
uniform vec3 eye_centre;                // metres, in the scene
uniform mat3 head_axes;                 // scene to the head's axes
#endif

vec3 light_from(vec3 n) {
    vec3 d = turned * n;
    return max(surroundings[0] + surroundings[1] * d.x + surroundings[2] * d.y + surroundings[3] * d.z
        + surroundings[4] * d.x * d.y + surroundings[5] * d.x * d.z + surroundings[6] * d.y * d.z
        + surroundings[7] * (d.x * d.x - d.y * d.y) + surroundings[8] * (3.0 * d.z * d.z - 1.0), vec3(0.02));
}

// light mirrored along r by a surface of this roughness: its lobe as a spherical Gaussian, folded with each light's
vec3 mirrored(vec3 r, float rough, float nv) {
    vec3 d = turned * r;
    float a = rough * rough;
    float own = 2.0 / (a * a) / max(4.0 * nv, 0.6);
    float up = d.y / (1.0 + 0.5 * a);
    vec3 light = up > 0.0 ? mix(sky[1], sky[0], smoothstep(0.0, 1.0, up)) : mix(sky[1], sky[2], smoothstep(0.0, 0.7, -up));
    for (int i = 0; i < lobes; i++) {
        float both = own + lobe_sharpness[i];
        light += lobe_light[i] * (own / both) * exp(own * lobe_sharpness[i] / both * (dot(lobe_axis[i], d) - 1.0));
    }
    return light;
}

vec2 split_sum(float rough, float nv) {
    vec4 r = rough * vec4(-1.0, -0.0275, -0.572, 0.022) + vec4(1.0, 0.0425, 1.04, -0.04);
    float a = min(r.x * r.x, exp2(-9.28 * nv)) * r.x + r.y;
    return vec2(-1.04, 1.04) * a + r.zw;
}

float ggx(vec3 n, vec3 v, vec3 l, float rough, float f0) {
    vec3 h = normalize(v + l);
    float nl = max(dot(n, l), 0.0), nv = max(dot(n, v), 1e-3), nh = max(dot(n, h), 0.0), vh = max(dot(v, h), 0.0);
    float a = rough * rough, a2 = a * a;
    float d = nh * nh * (a2 - 1.0) + 1.0;
    float visible = 0.5 / max(nl * sqrt(nv * nv * (1.0 - a2) + a2) + nv * sqrt(nl * nl * (1.0 - a2) + a2), 1e-4);
    float fresnel = f0 + (1.0 - f0) * pow(1.0 - vh, 5.0);
    return a2 / (PI * d * d) * visible * fresnel * nl;
}

// light between skin and skin is not lost
vec3 hollow(float open, vec3 colour) {
    vec3 a = 2.0404 * colour - 0.3324, b = -4.7951 * colour + 0.6417, c = 2.7552 * colour + 0.6903;
    return max(vec3(open), ((open * a + b) * open + c) * open);
}

float mirrored_open(float open, float nv, float rough) {
    return clamp(pow(nv + open, exp2(-16.0 * rough - 1.0)) - 1.0 + open, 0.0, 1.0);
}

float lit_by_key() {
    float lit = 1.0;
    #if defined(USE_SHADOWMAP) && NUM_DIR_LIGHT_SHADOWS > 0
    DirectionalLightShadow thrown = directionalLightShadows[0];
    lit = getShadow(directionalShadowMap[0], thrown.shadowMapSize, thrown.shadowIntensity, thrown.shadowBias,
                    thrown.shadowRadius, vDirectionalShadowCoord[0]);
    #endif
    return lit;
}

// how much light comes in between lips that are `mouth.z` apart, behind them
float in_the_mouth() {
    float behind = max(mouth.y - localAt.z, 0.0), gap = max(mouth.z, 0.0008);
    return gap / sqrt(gap * gap + 5.0 * behind * behind);
}

void main() {
    vec3 smooth_normal = normalize(facing) * (gl_FrontFacing ? 1.0 : -1.0);
    vec3 v = normalize(cameraPosition - seenAt);
    vec3 n = smooth_normal;
    vec3 colour = show_albedo ? texture2D(map, place).rgb : clay;
    float open = 1.0, rough = roughness, f0 = 0.028;
    vec3 specular_normal = n;

    #ifdef SKIN
    vec3 t = normalize(along.xyz - smooth_normal * dot(along.xyz, smooth_normal));
    vec3 b = along.w * cross(smooth_normal, t);
    vec3 bent = show_relief ? texture2D(normal_map, place).xyz * 2.0 - 1.0 : vec3(0.0, 0.0, 1.0);
    if (show_occlusion) open *= texture2D(occlusion_map, place).r;
    #ifdef KEYFRAMES
    if (show_details) {
        float phi[KEYFRAMES];
        for (int k = 0; k < KEYFRAMES; k++) phi[k] = apart[k];
        vec4 layers = detail_layers(place, phi);
        bent = detail_on(bent, layers.xyz);
        if (show_occlusion) open *= layers.w;
    }
    #endif
    n = normalize(bent.x * t + bent.y * b + max(bent.z, 0.05) * smooth_normal);
    specular_normal = n;
    float inside = kind.y;
    if (inside > 0.0) open *= mix(1.0, in_the_mouth(), inside);
    rough = mix(rough, 0.36, kind.x * 0.9);
    rough = mix(rough, 0.3, inside);
    rough = mix(rough, 0.75, kind.z);
    colour *= mix(0.5, 1.0, smoothstep(0.0, 0.8, kind.w));  // the bust ends softly
    #endif
    #ifdef MOUTH
    open = in_the_mouth();
    f0 = 0.04;
    #endif
    #ifdef EYE
    f0 = 0.028;
    vec3 from_centre = head_axes * normalize(seenAt - eye_centre);
    // lids and sockets stand before the ball: less light at its corners and under the upper lid
    float side = from_centre.x, up = from_centre.y;
    open = show_occlusion ? mix(0.36, 0.95, smoothstep(1.0, 0.3, length(vec2(side, up * 1.6 - 0.22)))) : 1.0;
    colour *= vec3(0.86, 0.84, 0.82);  // the ball's white is not paper
    #endif

    if (show_normals) {
        gl_FragColor = vec4(0.5 * n + 0.5, 1.0);
        return;
    }

    float nv = clamp(dot(specular_normal, v), 0.14, 1.0);  // hair too fine to see ends the mirror at grazing angles
    vec3 r = reflect(-v, specular_normal);
    float shadow = lit_by_key();
    vec3 darkened = hollow(open, clamp(colour, 0.0, 0.9));
    vec3 diffuse, specular;

    #ifdef SKIN
    vec3 red = show_skin_light ? normalize(mix(n, smooth_normal, 0.62)) : n;
    vec3 green = show_skin_light ? normalize(mix(n, smooth_normal, 0.28)) : n;
    vec3 blue = show_skin_light ? normalize(mix(n, smooth_normal, 0.12)) : n;
    diffuse = vec3(light_from(red).r, light_from(green).g, light_from(blue).b) * darkened;
    vec3 wrap = show_skin_light ? vec3(0.38, 0.16, 0.10) : vec3(0.0);
    vec3 towards = vec3(dot(red, key_direction), dot(green, key_direction), dot(blue, key_direction));
    vec3 reached = clamp((towards + wrap) / (1.0 + wrap), 0.0, 1.0) / (1.0 + 0.5 * wrap);
    float turned_away = dot(smooth_normal, key_direction);
    float kept = mix(1.0, shadow, smoothstep(-0.25, 0.15, turned_away));
    vec3 soft = pow(vec3(kept), show_skin_light ? vec3(0.7, 1.0, 1.1) : vec3(1.0));
    diffuse += key_light * reached * soft * mix(vec3(1.0), darkened, 0.5);
    // the finest hair catches light at grazing angles
    diffuse += 0.05 * pow(1.0 - nv, 3.0) * light_from(smooth_normal) * darkened * (1.0 - kind.y);

    float sharp = rough * 0.62, part = mix(0.28, 0.6, kind.x);
    float strength = mix(1.0, 0.35, kind.z);
    vec2 broad_sum = split_sum(rough, nv), sharp_sum = split_sum(sharp, nv);
    specular = mix(mirrored(r, rough, nv) * (f0 * broad_sum.x + broad_sum.y),
                   mirrored(r, sharp, nv) * (f0 * sharp_sum.x + sharp_sum.y), part);
    // what is mirrored from below is the body, which is not lit like the sky
    specular *= mirrored_open(open, nv, rough) * smoothstep(-0.75, 0.15, r.y) * smoothstep(-0.9, 0.1, n.y);
    specular += key_light * PI * shadow * open * mix(ggx(n, v, key_direction, rough, f0), ggx(n, v, key_direction, sharp, f0), part);
    specular *= show_albedo ? strength : 0.4;
    #else
    diffuse = light_from(n) * darkened;
    float towards = max((dot(n, key_direction) + 0.2) / 1.2, 0.0) / 1.1;
    diffuse += key_light * towards * shadow * open;
    vec2 sum = split_sum(rough, nv);
    specular = mirrored(r, rough, nv) * (f0 * sum.x + sum.y) * mirrored_open(open, nv, rough);
    specular += key_light * PI * shadow * open * ggx(n, v, key_direction, rough, f0);
    #endif

    gl_FragColor = vec4(colour * diffuse + specular, 1.0);
    #include <tonemapping_fragment>
    #include <colorspace_fragment>
}
