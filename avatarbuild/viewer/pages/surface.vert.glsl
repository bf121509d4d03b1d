// Vertices of every part of the head: morph targets, tangents, and for the skin how far each keyframe of the details is.
// Defines: SKIN, EYE or MOUTH; KEYFRAMES and EDGES where there are details (then synthesis.glsl stands before this).

#include <common>
#include <morphtarget_pars_vertex>
#include <shadowmap_pars_vertex>

varying vec3 seenAt;    // metres, in the scene
varying vec3 localAt;   // metres, in the head's own axes
varying vec3 facing;    // unit normal in the scene
varying vec2 place;     // texture coordinate
#ifdef SKIN
attribute vec4 tangent;
attribute vec4 traits;  // lips, inside of the mouth, scalp, distance to the rim
varying vec4 along;     // tangent in the scene, handedness
varying vec4 kind;
#ifdef KEYFRAMES
varying float apart[KEYFRAMES];
#endif
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
    float phi[KEYFRAMES];
    detail_distances(uv, phi);
    for (int k = 0; k < KEYFRAMES; k++) apart[k] = phi[k];
    #endif
    #endif
    #include <shadowmap_vertex>
    gl_Position = projectionMatrix * viewMatrix * worldPosition;
}
