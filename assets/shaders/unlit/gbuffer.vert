#version 450
// Projects vertices. The blocks are those that SAPIEN fills; names
// and order of their members are its interface.

layout(set = 0, binding = 0) uniform CameraBuffer {
  mat4 viewMatrix;
  mat4 projectionMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrixInverse;
  float width;
  float height;
} cameraBuffer;

layout(set = 1, binding = 0) uniform ObjectTransformBuffer {
  mat4 modelMatrix;
} objectTransformBuffer;

layout(set = 1, binding = 1) uniform ObjectDataBuffer {
  uvec4 segmentation;
  float transparency;
  int shadeFlat;
} objectDataBuffer;

layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;
layout(location = 3) in vec3 tangent;
layout(location = 4) in vec3 bitangent;

layout(location = 0) out vec2 outUV;

void main() {
  outUV = uv;
  vec4 world = objectTransformBuffer.modelMatrix * vec4(position, 1);
  vec4 seen = cameraBuffer.viewMatrix * world;
  gl_Position = cameraBuffer.projectionMatrix * seen;
}
