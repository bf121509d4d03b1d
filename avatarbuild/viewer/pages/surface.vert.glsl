// Vertices of every part of the head: morph targets, tangents, and for the skin how far each keyframe of the details is.
// Defines: SKIN, EYE or MOUTH; where there are details KEYFRAMES, QUARTETS of them, and the ROW of their texture.

#include <common>
#include <morphtarget_pars_vertex>
#include <shadowmap_pars_vertex>

centroid varying vec3 seenAt;    // metres, in the scene
centroid varying vec3 localAt;   // metres, in the head's own axes
centroid varying vec3 facing;    // unit normal in the scene
varying vec2 place;     // texture coordinate
#ifdef SKIN
attribute vec4 tangent;
attribute vec4 traits;  // lips, inside of the mouth, scalp, distance to the rim
centroid varying vec4 along;     // tangent in the scene, handedness
centroid varying vec4 kind;
#ifdef KEYFRAMES
uniform highp sampler2D quartets[QUARTETS];
centroid varying float apart[KEYFRAMES];
#endif
#endif

#ifdef KEYFRAMES
vec4 quartet(int i, ivec2 own) {  // arrays of textures are read by constant numbers only
    #if QUARTETS > 1
    if (i == 1) return texelFetch(quartets[1], own, 0);
    #endif
    #if QUARTETS > 2
    if (i == 2) return texelFetch(quartets[2], own, 0);
    #endif
    #if QUARTETS > 3
    if (i == 3) return texelFetch(quartets[3], own, 0);
    #endif
    return texelFetch(quartets[0], own, 0);
}
#endif

void main() {
    #include <beginnormal_vertex>
    #include <morphnormal_vertex>
    #include <begin_vertex>
    #include <morphtarget_vertex>
    vec4 worldPosition = modelMatrix * vec4(transformed, 1.0);
    vec3 transformedNormal = normalMatrix * objectNormal;  // what shadowmap_vertex reads
    seenAt = worldPosition.xyz;
    localAt = transformed;
    facing = mat3(modelMatrix) * objectNormal;
    place = uv;
    #ifdef SKIN
    along = vec4(mat3(modelMatrix) * tangent.xyz, tangent.w);
    kind = traits;
    #ifdef KEYFRAMES
    ivec2 own = ivec2(gl_VertexID % ROW, gl_VertexID / ROW);
    for (int k = 0; k < KEYFRAMES; k++) apart[k] = quartet(k / 4, own)[k % 4];
    #endif
    #endif
    #include <shadowmap_vertex>
    gl_Position = projectionMatrix * viewMatrix * worldPosition;
    #ifdef MOUTH
    // what lies within the mouth never shows through the lips: it counts as 3 mm further away
    vec4 behind = projectionMatrix * (viewMatrix * worldPosition - vec4(0.0, 0.0, 0.003, 0.0));
    gl_Position.z = behind.z / behind.w * gl_Position.w;
    #endif
}
