"use strict";var mienWebGpu=(()=>{var S=Object.defineProperty;var Z=Object.getOwnPropertyDescriptor;var Q=Object.getOwnPropertyNames;var ee=Object.prototype.hasOwnProperty;var re=(n,e)=>{for(var r in e)S(n,r,{get:e[r],enumerable:!0})},te=(n,e,r,t)=>{if(e&&typeof e=="object"||typeof e=="function")for(let a of Q(e))!ee.call(n,a)&&a!==r&&S(n,a,{get:()=>e[a],enumerable:!(t=Z(e,a))||t.enumerable});return n};var ae=n=>te(S({},"__esModule",{value:!0}),n);var le={};re(le,{findBackend:()=>ue});function C({neutral:n,basis:e,biases:r},t){return{width:n.length/Math.max(t,1),rank:e.length/Math.max(n.length,1),hidden:r[0].length}}function M({own:n,weights:e,biases:r},t,a){let o=r[0].length,s=n.length/Math.max(t,1),i=new Float32Array(t*o);for(let u=0;u<t;++u)for(let c=0;c<o;++c){let l=r[0][c];for(let d=0,h=c*(a+s)+a;d<s;++d)l+=e[0][h+d]*n[u*s+d];i[u*o+c]=l}return i}var E=class extends Error{};var he=1<<27,pe=1<<23;var k=class{constructor(e){this.device=e}device;buffers=[];storage(e,r=0){let{STORAGE:t,COPY_SRC:a}=GPUBufferUsage,{maxStorageBufferBindingSize:o,maxBufferSize:s}=this.device.limits,i=4*(typeof e=="number"?e:e.length);if(i>Math.min(o,s))throw new E("has more Gaussians than this device can hold");let u=this.buffer(i,t|a|r);return typeof e!="number"&&this.write(u,e),u}indirect(e){return this.storage(e,GPUBufferUsage.INDIRECT)}uniform(e){return this.buffer(4*e,GPUBufferUsage.UNIFORM)}write(e,r){this.device.queue.writeBuffer(e,0,r)}group(e,r){return this.device.createBindGroup({layout:e,entries:r.map((t,a)=>({binding:a,resource:{buffer:t}}))})}free(){for(let e of this.buffers)e.destroy()}buffer(e,r){let t=this.device.createBuffer({size:Math.max(64,e),usage:r|GPUBufferUsage.COPY_DST});return this.buffers.push(t),t}};function w(n,e,r,t){n.setPipeline(e),n.setBindGroup(0,r),n.dispatchWorkgroups(t)}var g=256,b=1024,A=128,N=`
struct Pose{
count:u32,triangles:u32,columns:u32,
bias:vec4f,
activations:array<vec4f,${A/4}>,
}
@group(0)@binding(0)var<uniform>pose:Pose;
fn activation(k:u32)->f32{return pose.activations[k>>2][k&3];}`,z=`${N}
@group(0)@binding(1)var<storage,read>points:array<f32>;
@group(0)@binding(2)var<storage,read>faces:array<u32>;
@group(0)@binding(3)var<storage,read_write>frames:array<vec4f>;
const DEGENERATE_LENGTH=1e-7;
fn at(i:u32)->vec3f{return vec3f(points[3*i],points[3*i+1],points[3*i+2]);}

@compute @workgroup_size(${g})
fn main(@builtin(global_invocation_id)id:vec3u){
let f=id.x;
if(f>=pose.triangles){return;}
let a=at(faces[3*f]);let b=at(faces[3*f+1]);let c=at(faces[3*f+2]);
var first=b-a;
var side=c-a;
var edge=length(first);
if(edge<DEGENERATE_LENGTH||length(cross(first,side))<DEGENERATE_LENGTH*edge){
first=vec3f(DEGENERATE_LENGTH,0,0);
side=vec3f(0,DEGENERATE_LENGTH,0);
edge=DEGENERATE_LENGTH;
}
first/=edge;
var normal=cross(first,side);
let height=length(normal);let k=(edge+height)/2;
normal/=height;
let last=cross(first,normal);let middle=(a+b+c)/3;
for(var row=0u;row<3;row++){frames[3*f+row]=vec4f(k*first[row],k*normal[row],k*last[row],middle[row]);}
}`,O=`${N}
@group(0)@binding(1)var<storage,read>restMeans:array<vec4f>;
@group(0)@binding(2)var<storage,read>restColors:array<vec4f>;
@group(0)@binding(3)var<storage,read>basis:array<vec4f>;
@group(0)@binding(4)var<storage,read_write>means:array<vec4f>;
@group(0)@binding(5)var<storage,read_write>colors:array<vec4f>;

@compute @workgroup_size(${g})
fn main(@builtin(global_invocation_id)id:vec3u){
let i=id.x;
if(i>=pose.count){return;}
var mean=restMeans[i];
var color=restColors[i];
for(var k=0u;k<pose.columns;k++){
let a=activation(k);let first=basis[2*(i*pose.columns+k)];
mean+=a*vec4f(first.xyz,0);
color+=a*vec4f(basis[2*(i*pose.columns+k)+1].xyz,first.w);
}
means[i]=mean;
colors[i]=color;
}`;function I(n,e,r){return`${N}
@group(0)@binding(1)var<storage,read>neutral:array<vec2u>;
@group(0)@binding(2)var<storage,read>basis:array<vec2u>;
@group(0)@binding(3)var<storage,read>own:array<vec2u>;
@group(0)@binding(4)var<storage,read>weights:array<vec4f>;
@group(0)@binding(5)var<storage,read_write>colors:array<vec4f>;
fn four(halves:vec2u)->vec4f{return vec4f(unpack2x16float(halves.x),unpack2x16float(halves.y));}

@compute @workgroup_size(${g})
fn main(@builtin(global_invocation_id)id:vec3u){
let i=id.x;
if(i>=pose.count){return;}
var f:array<vec4f,${n}>;
for(var t=0u;t<${n};t++){f[t]=four(neutral[i*${n}+t]);}
for(var k=0u;k<${e};k++){
let a=activation(k);
if(a !=0){
for(var t=0u;t<${n};t++){f[t]+=a*four(basis[(i*${e}+k)*${n}+t]);}
}
}
var sum=pose.bias;
for(var h=0u;h<${r};h++){
let w=h*${n+1};
var x=four(own[i*${r/4}+(h>>2)])[h&3];
for(var t=0u;t<${n};t++){x+=dot(weights[w+t],f[t]);}
sum+=weights[w+${n}]*select(x,${.01}*x,x<0);
}
colors[i]+=sum;
}`}var P=`
struct View{
head:array<vec4f,3>,
directions:array<vec4f,3>,
focal:vec2f,centre:vec2f,size:vec2f,
count:u32,shRest:u32,
background:vec4f,
}`,D=`
struct Splat{
place:vec4f,
shape:vec4f,
color:vec4f,
}`,$="near:NUMBER,far:NUMBER,vertices:u32,visible:NUMBER,firstVertex:u32,firstInstance:u32",V=`${P}${D}
struct State{${$.replace(/NUMBER/g,"atomic<u32>")}}
@group(0)@binding(0)var<uniform>view:View;
@group(0)@binding(1)var<storage,read>frames:array<vec4f>;
@group(0)@binding(2)var<storage,read>means:array<vec4f>;
@group(0)@binding(3)var<storage,read>shapes:array<vec4f>;
@group(0)@binding(4)var<storage,read>colors:array<vec4f>;
@group(0)@binding(5)var<storage,read>sh:array<vec4f>;
@group(0)@binding(6)var<storage,read_write>splats:array<Splat>;
@group(0)@binding(7)var<storage,read_write>keys:array<u32>;
@group(0)@binding(8)var<storage,read_write>state:State;
var<workgroup>near:atomic<u32>;
var<workgroup>far:atomic<u32>;
var<workgroup>visible:atomic<u32>;
const NEAR=0.01;
const DILATION=0.3;
const FOV_MARGIN=0.3;
const LOG2_ALPHA_MIN=-7.9943533;
const HALF_LOG2E=0.7213475;
const UNSEEN=0xffffffffu;

fn turn(quaternion:vec4f)->mat3x3f{
let q=normalize(quaternion);
let w=q.x;let x=q.y;let y=q.z;let z=q.w;
return mat3x3f(1.-2.*(y*y+z*z),2.*(x*y+w*z),2.*(x*z-w*y),
2.*(x*y-w*z),1.-2.*(x*x+z*z),2.*(y*z+w*x),
2.*(x*z+w*y),2.*(y*z-w*x),1.-2.*(x*x+y*y));
}

fn shRest(i:u32,d:vec3f)->vec3f{
let x=d.x;let y=d.y;let z=d.z;let xx=x*x;let yy=y*y;let zz=z*z;
let s=i*view.shRest;
var c=-0.48860252*y*sh[s].rgb+0.48860252*z*sh[s+1].rgb-0.48860252*x*sh[s+2].rgb;
if(view.shRest>3){
c+=1.0925485*x*y*sh[s+3].rgb-1.0925485*y*z*sh[s+4].rgb
+0.31539157*(2.*zz-xx-yy)*sh[s+5].rgb-1.0925485*x*z*sh[s+6].rgb
+0.54627424*(xx-yy)*sh[s+7].rgb;
}
if(view.shRest>8){
c+=-0.5900436*y*(3.*xx-yy)*sh[s+8].rgb+2.8906114*x*y*z*sh[s+9].rgb
-0.4570458*y*(4.*zz-xx-yy)*sh[s+10].rgb
+0.37317634*z*(2.*zz-3.*xx-3.*yy)*sh[s+11].rgb
-0.4570458*x*(4.*zz-xx-yy)*sh[s+12].rgb
+1.4453057*z*(xx-yy)*sh[s+13].rgb-0.5900436*x*(xx-3.*yy)*sh[s+14].rgb;
}
return c;
}


fn project(i:u32)->u32{
let color=colors[i];
let mean=means[i];
let f=3*u32(mean.w);
let a=frames[f];let b=frames[f+1];let c=frames[f+2];
let local=vec4f(mean.xyz,1);
let head=vec4f(dot(a,local),dot(b,local),dot(c,local),1);
let v=view.head;
let p=vec3f(dot(v[0],head),dot(v[1],head),dot(v[2],head));
let log2Opacity=-log2(1.+exp(min(-color.a,80.)));
if(p.z<=NEAR||log2Opacity<LOG2_ALPHA_MIN){return UNSEEN;}
let tangent=p.xy/p.z;
let margin=FOV_MARGIN*.5*view.size/view.focal;
let centre=view.focal*tangent+view.centre;
let clamped=clamp(tangent,-view.centre/view.focal-margin,(view.size-view.centre)/view.focal+margin);
let j=view.focal/p.z;
let n0=j.x*(v[0].xyz-clamped.x*v[2].xyz);
let n1=j.y*(v[1].xyz-clamped.y*v[2].xyz);
let frame=transpose(mat3x3f(a.xyz,b.xyz,c.xyz))*turn(shapes[2*i]);
let scale=shapes[2*i+1].xyz;
let u0=(n0*frame)*scale;let u1=(n1*frame)*scale;let area=cross(u0,u1);
var xx=dot(u0,u0);var yy=dot(u1,u1);let xy=dot(u0,u1);
let determinant=dot(area,area)+DILATION*(xx+yy)+DILATION*DILATION;
xx+=DILATION;yy+=DILATION;
if(!(xx<1e30&&yy<1e30&&determinant<1e30)){return UNSEEN;}

let reach=sqrt(max((log2Opacity-LOG2_ALPHA_MIN)*1.3862944,0.))+.1;
let box=reach*sqrt(vec2f(xx,yy));
if(any(centre+box<vec2f(0))||any(centre-box>view.size)){return UNSEEN;}
var rgb=0.5+0.2820948*color.rgb;
if(view.shRest>0){
let eye=-(v[0].w*v[0].xyz+v[1].w*v[1].xyz+v[2].w*v[2].xyz);
let d=normalize(head.xyz-eye);let t=view.directions;
rgb+=shRest(i,vec3f(dot(t[0].xyz,d),dot(t[1].xyz,d),dot(t[2].xyz,d)));
}
splats[i]=Splat(vec4f(centre,xy/yy,log2Opacity),
vec4f(sqrt(yy/determinant*HALF_LOG2E),sqrt(HALF_LOG2E/yy),sqrt(determinant/yy),sqrt(yy)),vec4f(max(rgb,vec3f(0)),reach));
return bitcast<u32>(p.z);
}

@compute @workgroup_size(${g})
fn main(@builtin(global_invocation_id)id:vec3u,@builtin(local_invocation_index)thread:u32){
if(thread==0){atomicStore(&near,UNSEEN);}
workgroupBarrier();
let i=id.x;
if(i<view.count){
let key=project(i);
keys[i]=key;
if(key !=UNSEEN){
atomicMin(&near,key);
atomicMax(&far,key);
atomicAdd(&visible,1);
}
}
workgroupBarrier();
if(thread==0&&atomicLoad(&visible)>0){
atomicMin(&state.near,atomicLoad(&near));
atomicMax(&state.far,atomicLoad(&far));
atomicAdd(&state.visible,atomicLoad(&visible));
}
}`,X=`${P}
struct State{${$.replace(/NUMBER/g,"u32")}}
override FIRST:bool;
@group(0)@binding(0)var<uniform>view:View;
@group(0)@binding(1)var<storage,read>state:State;
@group(0)@binding(2)var<storage,read>keysIn:array<u32>;
@group(0)@binding(3)var<storage,read>orderIn:array<u32>;
@group(0)@binding(4)var<storage,read_write>keysOut:array<u32>;
@group(0)@binding(5)var<storage,read_write>orderOut:array<u32>;
@group(0)@binding(6)var<storage,read_write>starts:array<u32>;
var<workgroup>counts:array<atomic<u32>,256>;
var<workgroup>sums:array<u32,256>;
var<workgroup>masks:array<atomic<u32>,2048>;

fn keyOf(i:u32)->u32{
let key=keysIn[i];
if(!FIRST){return key;}
if(key==0xffffffffu){return 65535;}
let near=bitcast<f32>(state.near);let far=bitcast<f32>(state.far);
return min(u32((far-bitcast<f32>(key))*(65535/max(far-near,1e-20))),65534);
}

fn digitOf(key:u32)->u32{return select(key>>8,key&255,FIRST);}

@compute @workgroup_size(${g})
fn count(@builtin(workgroup_id)group:vec3u,@builtin(local_invocation_index)thread:u32){
for(var round=0u;round<${b/g};round++){
let i=group.x*${b}+round*${g}+thread;
if(i<view.count){atomicAdd(&counts[digitOf(keyOf(i))],1);}
}
workgroupBarrier();
starts[group.x*256+thread]=atomicLoad(&counts[thread]);
}


@compute @workgroup_size(${g})
fn scan(@builtin(local_invocation_index)thread:u32){
let end=(view.count+${b-1})/${b}*256;
var sum=0u;
for(var k=thread;k<end;k+=256){sum+=starts[k];}
sums[thread]=sum;
workgroupBarrier();
var before=0u;
for(var digit=0u;digit<thread;digit++){before+=sums[digit];}
for(var k=thread;k<end;k+=256){
let here=starts[k];
starts[k]=before;
before+=here;
}
}

@compute @workgroup_size(${g})
fn scatter(@builtin(workgroup_id)group:vec3u,@builtin(local_invocation_index)thread:u32){
let word=thread>>5;let bit=1u<<(thread&31);
sums[thread]=starts[group.x*256+thread];
for(var round=0u;round<${b/g};round++){
for(var k=thread*8;k<thread*8+8;k++){atomicStore(&masks[k],0);}
workgroupBarrier();
let i=group.x*${b}+round*${g}+thread;let valid=i<view.count;
var key=0u;var digit=0u;
if(valid){
key=keyOf(i);
digit=digitOf(key);
atomicOr(&masks[digit*8+word],bit);
}
workgroupBarrier();
if(valid){
var to=sums[digit]+countOneBits(atomicLoad(&masks[digit*8+word])&(bit-1));
for(var k=digit*8;k<digit*8+word;k++){to+=countOneBits(atomicLoad(&masks[k]));}
if(FIRST){
keysOut[to]=key;
orderOut[to]=i;
}else{orderOut[to]=orderIn[i];}
}
workgroupBarrier();
for(var k=thread*8;k<thread*8+8;k++){sums[thread]+=countOneBits(atomicLoad(&masks[k]));}
}
}`,q=`${P}${D}
@group(0)@binding(0)var<uniform>view:View;
@group(0)@binding(1)var<storage,read>splats:array<Splat>;
@group(0)@binding(2)var<storage,read>order:array<u32>;
struct Corner{
@builtin(position)position:vec4f,
@location(0)@interpolate(flat)place:vec4f,
@location(1)@interpolate(flat)roots:vec2f,
@location(2)@interpolate(flat)color:vec3f,
}

@vertex fn corner(@builtin(vertex_index)vertex:u32,@builtin(instance_index)instance:u32)->Corner{
let s=splats[order[instance]];
let at=s.color.a*(vec2f(f32(vertex&1),f32(vertex>>1))*2.-1.)*s.shape.zw;
let pixel=s.place.xy+vec2f(s.place.z*at.y+at.x,at.y);
return Corner(vec4f(2.*pixel.x/view.size.x-1.,1.-2.*pixel.y/view.size.y,0,1),s.place,s.shape.xy,s.color.rgb);
}

@fragment fn blend(c:Corner)->@location(0)vec4f{
let d=c.position.xy-c.place.xy;
let r=c.roots*vec2f(d.x-c.place.z*d.y,d.y);
let power=c.place.w-dot(r,r);
if(power<-7.9943533){discard;}
let alpha=min(exp2(power),0.999);
return vec4f(c.color*alpha,alpha);
}`,H=`${P}
@group(0)@binding(0)var<uniform>view:View;
@group(0)@binding(1)var picture:texture_2d<f32>;

@vertex fn corner(@builtin(vertex_index)vertex:u32)->@builtin(position)vec4f{
return vec4f(vec2f(f32(vertex&1),f32(vertex>>1))*4.-1.,0,1);
}

@fragment fn show(@builtin(position)at:vec4f)->@location(0)vec4f{
var c=textureLoad(picture,vec2i(at.xy),0);
c+=(1.-c.a)*view.background;
return vec4f(clamp(c.rgb,vec3f(0),vec3f(c.a)),c.a);
}`;var j=8,_=class{constructor(e,r,t,a,o){this.memory=e;let{rig:s,faces:i,changes:u}=r,c=r.face_index.length,l=i.length/3;this.points=e.storage(s.template.length),this.told=new Float32Array(j+A),this.pose=e.uniform(this.told.length);let d=new Uint32Array(this.told.buffer);if(d[0]=c,d[1]=l,this.frames=this.step(z,l,[this.pose,this.points,e.storage(i),t.frames]),!u)return;if(u.directions.length/u.rest.length>A)throw new E(`has more than ${A} activations`);let{basis:h,columns:p}=oe(u,c);d[2]=p;let m=[a,o].map(y=>e.storage(y));this.changes.push(this.step(O,c,[this.pose,...m,e.storage(h),t.means,t.colors])),u.features&&this.addNetwork(u.features,c,t.colors)}memory;points;pose;frames;changes=[];told;run(e){let{device:r}=this.memory;this.memory.write(this.points,e.points);let t=r.createCommandEncoder(),a=t.beginComputePass(),o=[this.frames];e.changed&&(this.told.set(e.activations,j),o.push(...this.changes)),this.memory.write(this.pose,this.told);for(let{pipeline:s,group:i,threads:u}of o)w(a,s,i,Math.ceil(u/g));a.end(),r.queue.submit([t.finish()])}addNetwork(e,r,t){let{memory:a}=this,{width:o,rank:s,hidden:i}=C(e,r),{weights:u,biases:c}=e,l=Math.ceil(o/4),d=4*Math.ceil(i/4),h=u[0].length/i,p=new Float32Array(4*(l+1)*d);for(let f=0;f<i;++f){let v=4*(l+1)*f;p.set(u[0].subarray(f*h,f*h+o),v);for(let T=0;T<4;++T)p[v+4*l+T]=u[1][T*i+f]}this.told.set(c[1],4);let m=(f,v)=>a.storage(ne(se(f,v))),y=m(M(e,r,o),i),x=[m(e.neutral,o),m(e.basis,o),y,a.storage(p)];this.changes.push(this.step(I(l,s,d),r,[this.pose,...x,t]))}step(e,r,t){let{device:a}=this.memory,o=a.createComputePipeline({layout:"auto",compute:{module:a.createShaderModule({code:e})}});return{pipeline:o,group:this.memory.group(o.getBindGroupLayout(0),t),threads:r}}};function oe({means:n,opacity_logits:e,color:r},t){let a=[{part:n,width:3,at:0},{part:e,width:1,at:3},{part:r,width:3,at:4}],o=(u,c)=>(u?.length??0)/c/Math.max(t,1),s=Math.max(...a.map(({part:u,width:c})=>o(u,c))),i=new Float32Array(8*t*s);for(let{part:u,width:c,at:l}of a){let d=o(u,c);for(let h=0,p=0;h<t;++h)for(let m=0;m<c;++m)for(let y=0;y<d;++y)i[8*(h*s+y)+l+m]=u[p++]}return{basis:i,columns:s}}function se(n,e){let r=4*Math.ceil(e/4),t=n.length/e;if(r===e)return n;let a=new Float32Array(t*r);for(let o=0;o<t;++o)a.set(n.subarray(o*e,(o+1)*e),o*r);return a}function ne(n){if(typeof Float16Array>"u")throw new E("needs half floats, which this browser's WebGPU lacks");return new Uint32Array(new Float16Array(n).buffer)}var R=class{layout;digits;constructor(e){let r=["uniform",...Array(3).fill("read-only-storage"),...Array(3).fill("storage")];this.layout=e.createBindGroupLayout({entries:r.map((o,s)=>({binding:s,visibility:GPUShaderStage.COMPUTE,buffer:{type:o}}))});let t=e.createPipelineLayout({bindGroupLayouts:[this.layout]}),a=e.createShaderModule({code:X});this.digits=[1,0].map(o=>{let s=i=>e.createComputePipeline({layout:t,compute:{module:a,entryPoint:i,constants:{FIRST:o}}});return{count:s("count"),scan:s("scan"),scatter:s("scatter")}})}},U=class{constructor(e,r,t,a,o){this.pipelines=e;this.count=t;let[s,i,u,c]=Array.from({length:4},()=>r.storage(t)),l=r.storage(256*Math.ceil(t/b)),d=[[s,i,u,c],[u,c,s,i]];this.groups=d.map(h=>r.group(e.layout,[a,o,...h,l])),[this.keys,this.order]=[s,i]}pipelines;count;keys;order;groups;run(e){let r=Math.ceil(this.count/b);this.pipelines.digits.forEach(({count:t,scan:a,scatter:o},s)=>{let i=this.groups[s];w(e,t,i,r),w(e,a,i,1),w(e,o,i,r)})}};function G(n,e){for(let r=0,t=0;r<n.length;r+=3,t+=4)e[t]=n[r],e[t+1]=n[r+1],e[t+2]=n[r+2]}var K="rgba16float",W=36,Y=Uint32Array.of(4294967295,0,4,0,0,0),ie=8,B=class{constructor(e,r){this.device=e;this.format=r;let t=s=>e.createShaderModule({code:s});this.project=e.createComputePipeline({layout:"auto",compute:{module:t(V)}}),this.sort=new R(e);let a={srcFactor:"one",dstFactor:"one-minus-src-alpha"},o=(s,i,u)=>{let c=t(s);return e.createRenderPipeline({layout:"auto",vertex:{module:c},fragment:{module:c,targets:[i]},primitive:{topology:u}})};this.draw=o(q,{format:K,blend:{color:a,alpha:a}},"triangle-strip"),this.screen=o(H,{format:r},"triangle-list")}device;format;project;sort;draw;screen},F=class{constructor(e,r,t,a){this.pipelines=e;this.context=r;this.poser=a;let{device:o}=e,{baked:s}=t,{attributes:i,faces:u,face_index:c}=s,l=this.memory=new k(o),d=this.count=c.length;this.shRest=i.sh.length/3/Math.max(d,1)-1,[this.means,this.colors,this.shapeValues]=[4,4,8].map(f=>new Float32Array(f*d)),c.forEach((f,v)=>this.means[4*v+3]=f),G(s.means,this.means);for(let f=0;f<d;++f){let v=3*f*(1+this.shRest);this.colors.set([...i.sh.subarray(v,v+3),i.opacity_logits[f]],4*f)}let h=new Float32Array(4*d*this.shRest);for(let f=0;f<d*this.shRest;++f){let v=3*(f+Math.floor(f/this.shRest)+1);h.set(i.sh.subarray(v,v+3),4*f)}let p=this.posed={frames:l.storage(4*u.length),means:l.storage(this.means),colors:l.storage(this.colors)};this.shapes=l.storage(8*d),this.view=l.uniform(W),this.state=l.indirect(Y),this.sorter=new U(e.sort,l,d,this.view,this.state);let m=l.storage(12*d),y=this.sorter,x=[p.frames,p.means,this.shapes,p.colors,l.storage(h)];this.project=l.group(e.project.getBindGroupLayout(0),[this.view,...x,m,y.keys,this.state]),this.splats=l.group(e.draw.getBindGroupLayout(0),[this.view,m,y.order]),this.uploadShapes(i.quats,i.log_scales.map(Math.exp)),this.gpuPoser=s.skinned?null:new _(l,s,p,this.means,this.colors),r.configure({device:o,format:e.format,alphaMode:"premultiplied"})}pipelines;context;poser;memory;posed;shapes;view;state;gpuPoser;sorter;means;colors;shapeValues;project;splats;count;shRest;picture=null;screen=null;upload(){this.gpuPoser?this.gpuPoser.run(this.poser):this.uploadPosed(this.poser,this.poser.skinned)}draw(e,r,t){let{pipelines:a,count:o}=this,{device:s}=a,[i,u,c,l]=t,d=r.directions,h=new Float32Array(W);h.set(r.head),h.set([d[0],d[1],d[2],0,d[3],d[4],d[5],0,d[6],d[7],d[8]],12),h.set([...r.focal,...r.centre,r.width,r.height],24),new Uint32Array(h.buffer).set([o,this.shRest],30),h.set([i*l,u*l,c*l,l],32),this.memory.write(this.view,h),this.memory.write(this.state,Y);let p=s.createCommandEncoder(),m=p.beginComputePass();w(m,a.project,this.project,Math.ceil(o/g)),this.sorter.run(m),m.end();let y=this.pictureOf(r.width,r.height);this.render(p,y.createView(),a.draw,this.splats,x=>x.drawIndirect(this.state,ie)),this.render(p,this.context.getCurrentTexture().createView(),a.screen,this.screen,x=>x.draw(3)),s.queue.submit([p.finish()])}dispose(){this.picture?.destroy(),this.memory.free()}render(e,r,t,a,o){let s=e.beginRenderPass({colorAttachments:[{view:r,loadOp:"clear",storeOp:"store"}]});s.setPipeline(t),s.setBindGroup(0,a),o(s),s.end()}pictureOf(e,r){let{pipelines:t}=this,{device:a}=t;if(this.picture?.width===e&&this.picture.height===r)return this.picture;this.picture?.destroy();let{RENDER_ATTACHMENT:o,TEXTURE_BINDING:s}=GPUTextureUsage,i=this.picture=a.createTexture({size:[e,r],format:K,usage:o|s});return this.screen=a.createBindGroup({layout:t.screen.getBindGroupLayout(0),entries:[{binding:0,resource:{buffer:this.view}},{binding:1,resource:i.createView()}]}),i}uploadPosed(e,r){let{memory:t,posed:a,means:o,colors:s}=this;G(e.means,o),G(e.colors,s),e.opacityLogits.forEach((i,u)=>s[4*u+3]=i),t.write(a.frames,e.frames),t.write(a.means,o),t.write(a.colors,s),this.uploadShapes(r.quats,r.scales)}uploadShapes(e,r){let{shapeValues:t}=this;for(let a=0;a<this.count;++a){for(let o=0;o<4;++o)t[8*a+o]=e[4*a+o];for(let o=0;o<3;++o)t[8*a+4+o]=r[3*a+o]}this.memory.write(this.shapes,t)}};async function ue(n="auto"){if(n!=="webgl2")try{let e=await ce(n),r=e.lost;e.pushErrorScope("validation");let t=new B(e,navigator.gpu.getPreferredCanvasFormat()),a=await e.popErrorScope();if(a)throw new Error(a.message);return(...o)=>new L(t,r,...o)}catch(e){J(e.message);return}}var J=n=>console.warn(`mien: ${n}; WebGL2 draws instead`);async function ce(n){if(!navigator.gpu)throw new Error("this browser has no WebGPU, or the page has no secure address");let e=await navigator.gpu.requestAdapter({powerPreference:"high-performance"});if(!e)throw new Error("WebGPU has no adapter here");if(n==="auto"&&e.info.isFallbackAdapter)throw new Error("WebGPU has an adapter in software only");let{maxStorageBufferBindingSize:r,maxBufferSize:t}=e.limits;return e.requestDevice({requiredLimits:{maxStorageBufferBindingSize:r,maxBufferSize:t}})}var L=class{hidden=new OffscreenCanvas(1,1);screen;drawer;disposed=!1;constructor(e,r,t,a,o,s,i){this.screen=t.getContext("2d");let u=c=>{J(c),o.binds=!0,o.activations.fill(NaN);let l=this.hidden=new OffscreenCanvas(1,1);return l.addEventListener("webglcontextlost",d=>d.preventDefault()),l.addEventListener("webglcontextrestored",()=>{this.drawer=new i(l,a,o),s()}),new i(l,a,o)};o.binds=!1;try{this.drawer=new F(e,this.hidden.getContext("webgpu"),a,o)}catch(c){this.drawer=u(`this avatar ${c.message}`);return}r.then(({message:c})=>{this.disposed||(this.drawer=u(`the WebGPU device is lost (${c.trim()||"no reason is given"})`),s())}).catch(c=>console.error(`mien: ${c.message}`))}upload(){this.drawer.upload()}draw(e,r,t){let{hidden:a,screen:o}=this,{width:s,height:i}=r;(a.width!==s||a.height!==i)&&([a.width,a.height]=[s,i]),this.drawer.draw(e,r,t),o.globalCompositeOperation="copy",o.drawImage(a,0,0)}dispose(){this.disposed=!0,this.drawer.dispose()}};return ae(le);})();
