"""Light transport: the linear map from an environment map to a rendering, stored."""
